"""What a search shows, on a hypothesis whose planted load is known."""

import numpy as np
import pytest
from linear_plant import LOAD, A, B, model, recording

from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import Search, Stage, Trial
from simpel_cli.discovery.verdict.evidence import EvidenceTable, evidence_tables
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter, Optimum
from simpel_cli.filtering.setup import setup
from simpel_cli.filtering.setup import whole_windows as held_out
from simulators.effects import Expression

DRAG = Expression("drag", acts_on="v", term="-c*v*abs(v)", parameters={"c": {"range": [0, 1], "unit": "1/V"}})
PLANTED, C = 0.5, 0.2


@pytest.fixture(scope="module")
def shown() -> dict[str, EvidenceTable]:
    """Tables of a search that would have chosen the planted load, and a drag that is not there."""
    measured = recording(3, noise=0.01, load=PLANTED)
    plan = setup(model(), measured, (), [LOAD, DRAG], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=1, width=8))
    effects = [term.effect for term in plan.augmented.terms]
    load, drag = effects.index("load"), effects.index("drag")

    def trial(terms: tuple[int, ...], evidence: float, q: float) -> Trial:
        z = plan.start.copy()
        for row, value in zip((0, 1), (A, B), strict=True):
            z[row] = plan.coordinates.unit(row, value)
        for t, value in ((load, PLANTED), (drag, C)):
            if t in terms:
                z[search.rows[t][0]] = plan.coordinates.unit(search.rows[t][0], value)
        z[-2] = plan.coordinates.unit(len(z) - 2, q)
        free = search.free(terms)
        eye = np.eye(len(free))
        return Trial(
            terms, Optimum(z, free, 0.0, evidence, np.zeros(len(free)), 1e4 * eye, z[list(free)], 1e-4 * eye, 5, True)
        )

    base, one, other, both = (
        trial((), 0.0, 0.5),
        trial((load,), 90.0, 0.01),
        trial((drag,), 3.0, 0.3),
        trial((load, drag), 99.0, 0.01),
    )
    stages = (Stage(base, (one, other)), Stage(one, (both,)))
    selection = Selection(base, both, (base, one, both), ((), ()), stages, (90.0, 9.0), None)
    assessor = Assessor(plan, 3)
    windows = held_out(plan, measured.test, measured.outputs)
    before, after = (assessor(t.optimum.z, windows) for t in (base, both))
    return evidence_tables(search, selection, assessor, measured, windows, before, after)


def test_the_latent_force_is_the_planted_load(shown: dict[str, EvidenceTable]) -> None:
    table, units = shown["residuals"]
    assert set(table["model"]) == {"before", "without", "after"}
    assert set(table["split"]) == {"train", "test"}
    assert set(zip(table["acts_on"], table["unit"], strict=True)) == {
        ("v", "m/s^2")
    }  # s is kinematic: no force acts there
    assert units == {"time": "s", "s": "m", "v": "m/s", "u": "V"}
    own = table["model"] == "without"
    assert np.mean(table["force"][own]) == pytest.approx(PLANTED, abs=0.05)
    assert 0 < np.median(table["std"][own]) < 0.3


def test_effects_are_what_the_flow_makes_of_them(shown: dict[str, EvidenceTable]) -> None:
    """Over a row the velocity decays a little: the mean force is the sum of the terms times (1 - exp(-A dt))/(A dt)."""
    table, _ = shown["residuals"]
    own = (table["model"] == "without") & (np.abs(table["v"]) < 0.3)
    damped = (1 - np.exp(-A * 0.2)) / (A * 0.2)
    np.testing.assert_allclose(table["effect"][own], PLANTED * damped, atol=0.07)


def test_a_curve_is_its_expression(shown: dict[str, EvidenceTable]) -> None:
    """The drag has an argument; the load has none, hence no curve."""
    curve, _ = shown["effect_curves"]
    assert set(zip(curve["effect"], curve["argument"], curve["acts_on"], strict=True)) == {("drag", "v", "v")}
    np.testing.assert_allclose(curve["force"], -C * curve["value"] * np.abs(curve["value"]), atol=1e-12)


def test_steps_parameters_and_coverage(shown: dict[str, EvidenceTable]) -> None:
    steps, _ = shown["candidates"]
    assert steps["step"].tolist() == [1, 1, 2]
    assert steps["accepted"].tolist() == [True, False, True]
    assert steps["kept"].all()
    assert steps["log_evidence_gain"].tolist() == [90.0, 3.0, 9.0]
    parameters, _ = shown["parameters"]
    rows = list(zip(parameters["parameter"], parameters["effect"], parameters["model"], strict=True))
    assert ("a", "", "before") in rows
    assert ("c", "load on v", "after") in rows
    assert ("c", "load on v", "before") not in rows
    coverage, _ = shown["coverage"]
    assert coverage["quantity"].tolist() == ["s", "v", "u"]
    assert (coverage["low"] < coverage["high"]).all()


def test_errors_fall_and_free_runs_are_named(shown: dict[str, EvidenceTable]) -> None:
    runs, _ = shown["trajectories"]
    assert set(runs["episode"]) == {"4"}
    errors, _ = shown["errors"]
    assert errors["output"].tolist() == ["s", "v"] * 3
    np.testing.assert_allclose(errors["reduction"], errors["before"] / errors["after"])
    # one short test episode, through which the errors remember: no intervals
    assert np.isnan(errors["reduction_low"]).all()
    assert {"before", "after"} == set(shown["innovations"].columns["model"])
