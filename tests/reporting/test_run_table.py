"""What the report says of the gap's lengthscales."""

import numpy as np
import pytest

from simpel_cli.priors.function_prior import GapGP
from simpel_cli.reporting.run_table import lengthscales_in_words


def said(gap: GapGP | None, chosen: np.ndarray | None = None) -> str:
    return lengthscales_in_words(gap, chosen, ("v", "omega"), 4)


@pytest.mark.parametrize(
    ("gap", "words"),
    [
        (None, "no gap GP"),
        (GapGP(lengthscale=None), "4"),
        (GapGP(lengthscale=0.25), "0.25"),
        (GapGP(lengthscale=10.0, lengthscale_units="raw"), "10 in data units"),
    ],
)
def test_what_was_declared(gap: GapGP | None, words: str) -> None:
    assert said(gap) == words


def test_what_was_chosen_is_from_the_shortest_to_the_longest_of_all_seeds() -> None:
    chosen = np.array([[[4.0, 4.0], [0.5, 20.0]], [[4.0, 4.0], [0.4, 10.0]]])
    assert said(GapGP(), chosen) == "v 4, omega 0.4 to 20"
    assert said(GapGP(), np.full((2, 2, 2), 4.0)) == "4"
