"""Two names of one function: told by the model, not by a list."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.verdict.aliases import are_aliases, of_structure
from simpel_cli.filtering.likelihood.fit import Fitter, Optimum
from simpel_cli.filtering.setup import setup
from simulators.effects import Expression, Scales
from simulators.model import Declared

EFFECTS = [
    Expression("load", acts_on="v", term="c", parameters={"c": {"range": [-1, 1], "unit": "A"}}),
    Expression("offset", acts_on="input", term="u + b", parameters={"b": {"range": [-1, 1], "unit": "U"}}),
    Expression("drag", acts_on="v", term="-k*v*abs(v)", parameters={"k": {"range": [0, 2], "unit": "A/V^2"}}),
]


def searched(gain: str, effects: Sequence[Expression] = EFFECTS) -> Search:
    model = Declared(
        "hypothesis", dt=0.1,
        states={"s": {"unit": "m", "range": [-3, 3]}, "v": {"unit": "m/s", "range": [-3, 3]}},
        inputs={"u": {"unit": "V", "range": [-3, 3]}},
        parameters={"b": {"unit": "m/s^2/V", "range": [0.8, 1.8]}},
        dynamics={"s": "v", "v": f"{gain}*u"},
    ).model()  # fmt: skip
    random = np.random.default_rng(0)
    episodes = tuple(
        Episode(
            f"{k}", np.arange(12) * 0.1, random.normal(size=(12, 2)), random.normal(size=(12, 1)), np.zeros((12, 0))
        )
        for k in range(4)
    )
    recording = Recording(episodes[:3], episodes[3:], (), {"s": 0.1, "v": 0.1}, (), (Check("c", True, ""),), ())
    plan = setup(model, recording, (), effects, 1)
    return Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=1, width=12))


def fitted(search: Search, name: str, value: float) -> tuple[int, Trial]:
    t = next(i for i, term in enumerate(search.terms) if term.effect == name)
    z: Any = search.plan.start.copy()
    z[search.rows[t][0]] = search.plan.coordinates.unit(search.rows[t][0], value)
    free = search.free((t,))
    nothing = np.zeros(len(free)), np.eye(len(free)), z[list(free)], np.eye(len(free))
    return t, Trial((t,), Optimum(z, free, 0.0, 0.0, *nothing, 1, True))


@pytest.mark.parametrize(("gain", "same"), [("b", True), ("b*(1 + 0.5*s)", False)])
def test_an_offset_is_a_load_where_the_input_enters_with_a_constant_gain(gain: str, same: bool) -> None:
    search = searched(gain)
    load, offset, drag = (fitted(search, name, 0.4) for name in ("load", "offset", "drag"))
    assert are_aliases(search, load[1], load, offset) is same
    assert not are_aliases(search, load[1], load, drag)
    assert are_aliases(search, load[1], load, fitted(search, "load", 0.2))


@pytest.mark.parametrize(("measured", "inputs", "same"), [("s", "u", True), ("sv", "u", False), ("s", "uw", False)])
def test_one_late_input_is_one_late_sensor(measured: str, inputs: str, same: bool) -> None:
    """Whatever the evidence says, which differs by what is assumed of the time before the first row."""
    search: Any = searched("b")
    model = search.plan.augmented.model
    model = replace(model, inputs=tuple(model.inputs[0]._replace(name=name) for name in inputs))
    late = {"range": [0, 0.3], "unit": "s"}
    terms = [
        term
        for kind, place in (("delay", "input"), ("sensor_delay", "measured"), ("lag", "input"))
        for term in Expression(kind, acts_on=place, operator=kind, parameters={"d": late}).attach(
            model, Scales(dict.fromkeys("svuw", 1.0), dict.fromkeys("sv", 1.0), 0.1), tuple(measured)
        )
    ]
    augmented = search.plan.augmented._replace(model=model, measured=tuple(measured))
    search.plan, search.terms = search.plan._replace(augmented=augmented), terms
    first, second, lag = (next(t for t in terms if t.kind == k) for k in ("delay", "sensor_delay", "lag"))
    assert of_structure(search, first) == ([second] if same else [])
    assert of_structure(search, second) == ([first] if same else [])
    assert of_structure(search, lag) == []
