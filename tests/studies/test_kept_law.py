"""The law of the noise that `data.noise.law: auto` came to is read from the checkpoint, not decided again."""

from pathlib import Path

import numpy as np
import pytest

from simpel_cli.runs.checkpoint import keep
from simpel_cli.studies.training import law_kept


@pytest.mark.parametrize(("law", "more"), [("gaussian", {}), ("student_t", {"tail": np.array([[0.3]])})])
def test_the_checkpoint_says_which_law(tmp_path: Path, law: str, more: dict[str, np.ndarray]) -> None:
    assert law_kept(tmp_path) is None
    keep(tmp_path, {"state": np.zeros(2), "problem": {"gap_scale": np.ones((1, 1))} | more}, {"step": 1})
    assert law_kept(tmp_path) == law
