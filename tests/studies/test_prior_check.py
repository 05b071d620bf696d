"""What a fit says of its prior before it trains."""

from pathlib import Path

import pytest

from simpel_cli.inference.prior_predictive import OutputCheck, PriorCheck
from simpel_cli.reporting.prior_check import describe_prior
from simpel_cli.runs.console import Terminal

FINE = OutputCheck("s", "m", 0, 20, 1.1, 0.4, 0.9, 0.6)
BY_GAP = OutputCheck("v", "m/s", 3, 20, 4.2, 0.001, 1.2, 0.3)
LOST = OutputCheck("w", "1", 0, 20, 9.0, 0.001, 5.0, 0.001)


def said(tmp_path: Path, *outputs: OutputCheck) -> str:
    terminal = Terminal(True, tmp_path / "run.log")
    describe_prior(terminal, PriorCheck(outputs, {}))
    return (tmp_path / "run.log").read_text()


def test_a_prior_that_explains_the_data(tmp_path: Path) -> None:
    assert "explains the training data (distance at most 1.1 times" in said(tmp_path, FINE)


def test_what_only_the_gap_explains_and_what_nothing_does(tmp_path: Path) -> None:
    text = said(tmp_path, FINE, BY_GAP, LOST)
    assert (
        "the simulator alone does not explain v (distance 4.2 times that of its own draws, 3 of 20 targets outside"
        in text
    )
    assert "with the gap GP it does" in text
    assert "does not explain w (distance 9 times" in text
    assert "simpel discover" in text
    assert "method=simpel" not in text


def test_draws_that_run_away_are_counted(tmp_path: Path) -> None:
    assert "runs away" not in said(tmp_path, FINE)
    describe_prior(Terminal(True, tmp_path / "run.log"), PriorCheck((FINE,), {}, 3, 2048))
    assert "the integration of 3 of 2048 draws of the simulator runs away" in (tmp_path / "run.log").read_text()


@pytest.mark.parametrize("outside", [0, 2])
def test_without_a_gap_a_simulator_that_does_not_explain_the_data_is_told_to_take_one(
    tmp_path: Path, outside: int
) -> None:
    alone = OutputCheck("v", "m/s", outside, 20, 4.2, 0.4 if outside else 0.001, None, None)
    text = said(tmp_path, FINE._replace(distance_with_gap=None, p_with_gap=None), alone)
    assert "does not explain v" in text
    assert "with the gap GP it does" not in text
    assert "add a gap GP (method=simpel)" in text
