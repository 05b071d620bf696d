"""The second exam: what its nuisances do to a record, and that they are scored as nuisances."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from tests.exam import nuisances as real
from tests.exam.draw import FULL, NONE, Set, draw_second
from tests.exam.integrate import simulate
from tests.exam.plants import SYSTEMS
from tests.exam.record import record, truth
from tests.exam.score import FALSE, RIGHT, outcome
from tests.exam.table import report
from tests.exam.write import write


def quiet(*names: str, system: str = "pendulum", noise: float = 0.01) -> Set:
    return Set(7, system, NONE, (), (), noise, FULL, "own", 11, names)


def test_one_to_three_are_drawn_that_do_not_hide_each_other() -> None:
    sets = [draw_second(i, 5) for i in range(300)]
    counts = Counter(n for d in sets for n in d.nuisances)
    assert set(counts) == set(real.ALL)
    assert {len(d.nuisances) for d in sets} == {1, 2, 3}
    assert all(len(set(d.nuisances)) == len(d.nuisances) for d in sets)
    assert not any(set(pair) <= set(d.nuisances) for d in sets for pair in real.APART)
    assert sets[3] == draw_second(3, 5)


@pytest.mark.parametrize(
    ("name", "system"), [(n, s) for s in SYSTEMS for n in real.ALL if real.possible(n, SYSTEMS[s], ())]
)
def test_each_changes_the_record(name: str, system: str) -> None:
    with_it, without = record(quiet(name, system=system)), record(quiet(system=system))
    assert with_it.measured.shape == without.measured.shape
    assert not np.array_equal(with_it.measured, without.measured, equal_nan=True)
    assert with_it.parameters == without.parameters
    if name != real.LATE:  # what a late sensor shows first lies before the record
        np.testing.assert_array_equal(with_it.commands, without.commands)


@pytest.mark.parametrize("lag", [0.0, 0.3])
def test_linear_commands_are_integrated_exactly(lag: float) -> None:
    """dx/dt = z behind a lag: of a ramp u = t the lag delivers t - tau (1 - exp(-t/tau)), which is integrated by hand."""
    u = np.arange(21.0)[None, :, None] * 0.1
    states, _, _ = simulate(lambda x, z, _: z, np.zeros((1, 1)), u, 0.1, lag=[lag], linear=True)
    t = np.arange(21) * 0.1
    tau = lag or 1.0
    expected = t**2 / 2 - (tau * t - tau**2 * (1 - np.exp(-t / tau)) if lag else 0.0)
    np.testing.assert_allclose(states[0, :-1, 0], expected[:-1], atol=1e-6)


def test_tails_have_the_variance_of_the_noise() -> None:
    random = np.random.default_rng(0)
    heavy = real.noise_of((real.HEAVY,), random, (400_000,))
    assert heavy.std() == pytest.approx(1.0, abs=0.1)
    assert np.mean(np.abs(heavy) > 4) > 30 * np.mean(np.abs(real.noise_of((), random, (400_000,))) > 4)


def test_a_parameter_differs_from_episode_to_episode_or_drifts_within_one() -> None:
    random = np.random.default_rng
    _, differs = real.parameters_of((real.DIFFERING,), random(0), {"a": 2.0, "b": 1.0}, 50, 3.0)
    values = [v for v in differs(0.0).values() if np.ndim(v)]
    assert len(values) == 1
    assert np.std(values[0]) / np.mean(values[0]) == pytest.approx(real.DIFFERS, rel=0.3)
    assert all(np.array_equal(a, b) for a, b in zip(differs(0.0).values(), differs(2.0).values(), strict=True))
    name, drifts = real.parameters_of((real.DRIFT,), random(0), {"a": 2.0}, 50, 3.0)
    assert abs(drifts(3.0)[name] - drifts(0.0)[name]) == pytest.approx(real.DRIFTS * 2.0)
    assert real.parameters_of((), random(0), {"a": 2.0}, 50, 3.0)[1](1.0) == {"a": 2.0}


def test_a_late_speed_is_late_by_what_is_said() -> None:
    late = record(quiet(real.LATE, noise=1e-9))
    t = np.arange(late.true.shape[1]) * SYSTEMS["pendulum"].dt
    for e in range(2):
        then = np.interp(t[4:] - real.ROWS_LATE * SYSTEMS["pendulum"].dt, t, late.true[e, :, 1])
        np.testing.assert_allclose(late.measured[e, 4:, 1], then, atol=0.02 * np.std(late.true[..., 1]))
    np.testing.assert_allclose(late.measured[..., 0], late.true[..., 0], atol=1e-6)


def test_groups_are_told_where_a_parameter_differs(tmp_path: Path) -> None:
    for name, groups in ((real.DIFFERING, ["unit"]), (real.DRIFT, None)):
        folder = tmp_path / name.split()[0]
        write(quiet(name), folder / "set", folder / "truth.json")
        assert yaml.safe_load((folder / "set" / "data" / "rig.yaml").read_text()).get("groups") == groups
        table = pd.read_parquet(folder / "set" / "data" / "run.parquet")
        assert ("unit" in table) is bool(groups)
        assert len(truth(quiet(name), record(quiet(name)))["parameters"]) == len(SYSTEMS["pendulum"].ranges) - 1


def claim(name: str, place: str) -> dict[str, Any]:
    return {"name": name, "acts_on": place, "class": [name], "class_members": [{"name": name, "acts_on": place}]}


def verdict(**others: Any) -> dict[str, Any]:
    said = {"verdict": "none", "effects": [], "data_checks": [], "grouping": [], "remainder": None, "between_rows": {}}
    return said | {"degrees_of_freedom": {}} | others


def test_an_effect_that_is_the_nuisance_is_not_false() -> None:
    told = truth(quiet(real.LATE), record(quiet(real.LATE)))
    late = verdict(verdict="effect", effects=[claim("sensor_delay", "omega")])
    assert outcome(told, late) != FALSE
    assert outcome(told, verdict(verdict="effect", effects=[claim("input_lag", "u")])) == FALSE
    assert outcome(truth(quiet(real.GAPS), record(quiet(real.GAPS))), late) == FALSE
    assert outcome(told, verdict()) == RIGHT


def test_what_is_said_of_a_nuisance() -> None:
    system = SYSTEMS["pendulum"]
    every = (real.LINEAR, real.HEAVY, real.LATE, real.DIFFERING, real.DRIFT, real.GAPS, real.OFFSET)
    assert not any(real.named(every, system, verdict()).values())
    said = verdict(
        effects=[claim("sensor_lag", "omega")], between_rows={"u": {"word": "linear"}}, degrees_of_freedom={"phi": 3.0},
        grouping=[{"parameter": "m", "pays": True}], remainder={"depends_on": ["time"], "description": ""},
    )  # fmt: skip
    found = real.named(every, system, said)
    assert all(found.values())
    assert set(found) == set(every) - {real.GAPS, real.OFFSET}


def test_the_table_has_the_nuisances_and_the_errors_that_grow() -> None:
    rows = [
        {"index": i, "system": "cart", "kind": "none", "noise": 0.01, "condition": FULL, "world": "own", "planted": "",
         "outcome": RIGHT, "names": "", "evidence": None, "message": "", "nuisances": "drift", "grown": grown,
         "named": '{"drift": false}', "seconds": 9.0, "candidates": 3, "verdict": "none"}
        for i, grown in enumerate(["", "v in free run"])
    ]  # fmt: skip
    text = report(pd.DataFrame(rows))
    assert "nuisance named: drift | >= 80 % | 0/2" in text
    assert "grows certainly, any quantity and horizon | 0 | 1/2" in text
    assert "## By nuisances" in text
