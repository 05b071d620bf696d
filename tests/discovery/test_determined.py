"""Which combinations of parameters a record determines, and which it leaves open."""

from typing import Any

import numpy as np
import pytest
from test_ranges import measured

from simpel_cli.discovery.search.trials import Search
from simpel_cli.discovery.verdict.determined import Open, left_open, sentence_of
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup
from simulators.model import Declared


def searched(parameters: dict[str, Any], gain: str) -> Search:
    model = Declared(
        "cart", dt=0.1,
        states={"s": {"unit": "m", "range": [-30, 30]}, "v": {"unit": "m/s", "range": [-9, 9]}},
        inputs={"u": {"unit": "V", "range": [-3, 3], "between_rows": "held"}},
        parameters={name: {"unit": "A", **node} for name, node in parameters.items()},
        dynamics={"s": "v", "v": gain},
    ).model()  # fmt: skip
    plan = setup(model, measured(1.2), (), (), 1)
    return Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=1, width=9))


@pytest.mark.parametrize(
    ("parameters", "gain", "words"),
    [
        ({"b": {"range": [0.8, 1.8]}}, "b*u", []),
        ({"k": {"range": [2, 4]}, "m": {"range": [1.5, 4]}}, "k/m*u", ["only k/m is determined"]),
        ({"k": {"range": [2, 4]}, "m": {"range": [0.3, 0.6]}}, "k*m*u", ["only k*m is determined"]),
        ({"b": {"range": [0.8, 1.8]}, "c": {"range": [1, 2]}}, "b*u + 0*c", ["c"]),
        (
            {"k": {"range": [2, 4], "prior": "lognormal"}, "r": {"range": [1.2, 2], "prior": "lognormal"}}, "k/r**2*u",
            ["only k/r^2 is determined"],
        ),
        ({"b": {"range": [-3, 3]}, "c": {"range": [-3, 3]}}, "(b + c)*u", ["b up with c down", "b down with c up"]),
    ],
)  # fmt: skip
def test_what_is_left_open(parameters: dict, gain: str, words: list[str]) -> None:
    search = searched(parameters, gain)
    found = left_open(search, search.base())
    assert len(found) == (len(words) > 0)
    assert not words or any(found[0].words.endswith(w) for w in words)
    assert all(0 <= one.information < 1 for one in found)


def test_the_sentence() -> None:
    assert sentence_of([]) == ""
    both = Open({"k": 1.0, "m": 0.98}, True, 0.0)
    assert both.words == "k up with m up: only k/m is determined"
    said = sentence_of([both._asdict() | {"words": both.words}, {"words": "c"}])
    assert said == " These data do not determine k up with m up: only k/m is determined; nor c."
    three = Open({"k": 1.0, "m": 0.98, "l": -0.5}, True, 0.0)
    assert three.words == "k up with m up with l down"


def test_where_nothing_is_determined_no_ratio_is() -> None:
    search = searched({"k": {"range": [2, 4]}, "m": {"range": [1.5, 4]}}, "k/m*u")
    base = search.base()
    weak = base._replace(optimum=base.optimum._replace(fisher=np.eye(len(base.optimum.free))))
    found = left_open(search, weak)
    assert len(found) == 2
    assert not any("only" in one.words for one in found)


def test_a_fit_that_went_astray_says_nothing() -> None:
    search = searched({"b": {"range": [0.8, 1.8]}}, "b*u")
    base = search.base()
    lost = base._replace(optimum=base.optimum._replace(fisher=np.full_like(base.optimum.fisher, np.nan)))
    assert left_open(search, lost) == []
