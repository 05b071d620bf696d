"""A run whose rows do not count alike is interrupted and resumed: noise that goes with the row, and a sensor that saturates."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import line, rows, simpel

from simpel_cli.errors import Interrupted
from simpel_cli.inference import loop

HIGH = 5.0
SCALE = {"noise": {"scale": {"y": "0.1 + 0.2*x"}}}
DECLARED = {"scale": SCALE, "sensor": SCALE | {"sensor": {"y": {"saturates": [None, HIGH]}}}}
FEW = ("method.steps=1000", "method.particles=3", "method.network.hidden=[8]", "method.pool=64", "method.sets=8",
       "prior.draws=64", "run.figures=false", "run.quiet=true")  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unequal")
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 4, 60)
    y = np.minimum(2 * x + (0.1 + 0.2 * x) * rng.normal(size=60), HIGH)
    line(folder, x, y, 40, DECLARED)
    return folder


@pytest.mark.parametrize("declared", DECLARED)
def test_an_interrupted_run_goes_on_to_the_same_end(declared: str, folder: Path) -> None:
    """Stopped after its first stretch: targets at an end, weights and the typical noise are those that it began with."""
    words = ("fit", "--config-dir", "my", "sim=line", f"data={declared}", *FEW)
    assert simpel(folder, *words, f"hydra.run.dir={declared}").code == 0
    whole, parts = folder / declared, folder / f"{declared}_in_parts"
    kept, stretches = loop.train, []

    def stopping(*given: Any, **more: Any) -> Any:
        for one in kept(*given, **more):
            stretches.append(one.step)
            yield one
            raise Interrupted("stopped by the test")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "train", stopping)
        assert simpel(folder, *words, f"hydra.run.dir={parts.name}").code == Interrupted.exit_code
    assert 0 < stretches[0] < 1000
    done = simpel(folder, "fit", "--resume", parts.name)
    assert done.code == 0, done.err
    assert rows(parts) == rows(whole)
    assert {row["step"] for row in rows(parts) if row["split"] == "train"} >= {stretches[0], 1000}
    state = Path("checkpoint") / "state.safetensors"
    assert (parts / state).read_bytes() == (whole / state).read_bytes()
    again = simpel(folder, "evaluate", parts.name, f"hydra.run.dir={declared}_again")
    assert again.code == 0, again.err
    found = [
        {k: v for k, v in row.items() if k != "command"} for row in rows(folder / f"{declared}_again", split="test")
    ]
    known = [{k: v for k, v in row.items() if k != "command"} for row in rows(whole, split="test")]
    assert [row["value"] for row in found] == pytest.approx([row["value"] for row in known], rel=1e-6, nan_ok=True)
