"""A search within a time: what there is no time for is left out, and said."""

from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from test_selection import Table

from simpel_cli.config.build import build
from simpel_cli.discovery.search.budget import Budget, seconds_of
from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.watch import Watch
from simpel_cli.errors import ConfigError
from simpel_cli.runs.console import Terminal


@pytest.mark.parametrize(
    ("given", "seconds"),
    [(None, None), (60, 60.0), (0.5, 0.5), ("60s", 60.0), (" 2 min ", 120.0), ("1h", 3600.0), ("7", 7.0)],
)
def test_times(given: Any, seconds: float | None) -> None:
    assert seconds_of(given) == seconds
    build({"budget": given}, "discovery")


@pytest.mark.parametrize("given", ["soon", "60 days", 0, -1.0, "0s", "-5s"])
def test_what_is_no_time_is_told_what_is(given: Any) -> None:
    with pytest.raises(
        ConfigError, match=r"discovery\.budget: got .*; give a time above 0, in seconds or as 60s, 2min, 1h"
    ):
        build({"budget": given}, "discovery")


def test_a_budget_says_once_what_was_left_out() -> None:
    now = [0.0]
    budget = Budget(10.0, lambda: now[0])
    assert not budget.over("first")
    assert budget.sentence == ""
    now[0] = 10.5
    assert budget.over("second")
    assert budget.over("second")
    assert budget.over("third")
    assert budget.sentence == " Left out for lack of time (discovery.budget): second; third."
    assert not Budget().over("anything")


def test_the_first_effect_is_found_in_any_case() -> None:
    search = Table({"": 0.0, "A": 30.0, "B": 20.0, "AB": 60.0, "C": 62.0}).search
    whole = select(search)
    assert [search.terms[t].effect for t in whole.chosen.terms] == ["C"]
    hurried: Any = Table({"": 0.0, "A": 30.0, "B": 20.0, "AB": 60.0}).search
    hurried.budget = Budget(1.0, iter([0.0] + [2.0] * 99).__next__)
    found = select(hurried)
    assert [hurried.terms[t].effect for t in found.chosen.terms] == ["A"]
    assert "effects beside those found" in hurried.budget.left_out
    assert found.stages[-1].before.terms == ()


def test_what_goes_on_is_said_with_the_time_and_none_is_guessed() -> None:
    now = [0.0]
    watch = Watch(Budget(None, lambda: now[0]))
    assert str(watch).strip() == "0:00 min so far"
    now[0] = 75.9
    watch(12, 76)
    assert str(watch).strip() == "12 of 76 fits · 1:15 min so far"
    watch(0, 0)
    assert str(watch).strip() == "1:15 min so far"
    watch = Watch(Budget(90.0, lambda: now[0]))
    now[0] += 60.0
    assert str(watch).strip() == "1:00 min so far · 0:30 min left"
    now[0] += 60.0
    assert str(watch).strip() == "2:00 min so far · 0:00 min left"


def test_a_line_below_the_others_is_drawn_where_somebody_looks(tmp_path: Path) -> None:
    for looks in (True, False):
        terminal, shown = Terminal(False, tmp_path / "run.log"), StringIO()
        terminal.console = Console(file=shown, force_terminal=looks, _environ={"TERM": "xterm"})
        with terminal.working(lambda: "3 of 8 fits"):
            terminal.line("calibrated", "search")
        assert ("3 of 8 fits" in shown.getvalue()) == looks
        assert "calibrated" in shown.getvalue()
    assert "fits" not in (tmp_path / "run.log").read_text()
