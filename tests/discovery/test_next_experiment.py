"""The next experiment: its figure against closed forms, and what it chooses on a pendulum with weak data."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from linear_plant import DT, LOAD, ROWS, A, B, model, recording

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.next_experiment.candidates import DRIVEN, FREE, Proposal, signal
from simpel_cli.discovery.next_experiment.design import FILE, Class, Designer, class_of, next_experiment
from simpel_cli.discovery.next_experiment.discrimination import Members, forecast
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import Search, Stage
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import Setup, setup
from simulators.effects import Expression
from simulators.model import Declared, Quantity

SPREAD = np.array([0.8, 1.1])


def law(a: float, b: float, load: float, r: np.ndarray, q: float, u: np.ndarray, spread: np.ndarray) -> Any:
    """Mean and covariance of all measurements of dv/dt = b u - a v + load, ds/dt = v, written down densely."""
    decay = np.exp(-a * DT)
    f = np.array([[1.0, (1 - decay) / a], [0.0, decay]])
    half = np.diag([0.0, q**2 * DT / 2])
    mean, joint, means = np.array([0.2, -0.3]), np.zeros((2 * ROWS, 2 * ROWS)), []
    joint[:2, :2] = np.diag(spread**2)
    for k in range(ROWS):
        if k:
            end = (b * u[k - 1] + load) / a
            mean = f @ mean + [end * DT - end * (1 - decay) / a, end * (1 - decay)]
            rows, last = slice(2 * k, 2 * k + 2), slice(2 * k - 2, 2 * k)
            joint[rows, : 2 * k] = f @ joint[last, : 2 * k]
            joint[: 2 * k, rows] = joint[rows, : 2 * k].T
            joint[rows, rows] = f @ (joint[last, last] + half) @ f.T + half
        means.append(mean)
    return np.concatenate(means), joint + np.diag(np.tile(r**2, ROWS))


def expected(true: Any, judge: Any) -> float:
    """Expected log density of one Gaussian under another, up to a constant."""
    away = true[0] - judge[0]
    inside = np.linalg.solve(judge[1], true[1] + np.outer(away, away))
    return -0.5 * (np.linalg.slogdet(judge[1])[1] + np.trace(inside))


@pytest.fixture(scope="module")
def hypothesis() -> tuple[Setup, Any]:
    """The hypothesis, and its compiled forecast."""
    plan = setup(model(), recording(), (), [LOAD], 2)
    return plan, jax.jit(partial(forecast, plan.rule, rows=ROWS, dt=DT))


@pytest.mark.parametrize("sd", [0.0, 0.15])
def test_the_figure_is_the_divergence_of_two_gaussians(hypothesis: tuple[Setup, Any], sd: float) -> None:
    """Two hypotheses that differ in load, damping and both noises; parameters known, and load and gain known to within sd."""
    plan, program = hypothesis
    names = [q.name for q in plan.augmented.params]
    truth = [(A, B, 0.0, np.array([0.05, 0.07]), 0.3), (0.5, 1.1, 0.4, np.array([0.06, 0.07]), 0.2)]
    points, laws = [], []
    u = np.random.default_rng(2).normal(size=ROWS)
    for a, b, load, r, q in truth:
        p = np.tile(plan.augmented.neutral, (5, 1))
        p[:, :2] = a, b
        p[:, names.index("load_v_c")] = load
        p[[1, 3], 1] += np.array([sd, -sd])
        p[[2, 4], names.index("load_v_c")] += np.array([sd, -sd])
        points.append(p)
        known = law(a, b, load, r, q, u, SPREAD)
        moved = [law(a, b + sd, load, r, q, u, SPREAD)[0], law(a, b, load + sd, r, q, u, SPREAD)[0]]
        laws.append((known, (known[0], known[1] + sum(np.outer(m - known[0], m - known[0]) for m in moved))))
    members = Members(
        jnp.asarray(np.stack(points)), jnp.asarray(np.stack([t[3] for t in truth])),
        jnp.asarray([[[0.0, t[4]]] * 2 for t in truth]), jnp.asarray(np.log(np.full((2, 2), 0.5))),
    )  # fmt: skip
    past = np.concatenate([np.full(plan.lead, u[0]), u])[None, :, None]
    start, spread = jnp.array([[0.2, -0.3]]), jnp.asarray(SPREAD)
    told = program(members, jnp.asarray(past), start, spread, spread, jnp.zeros(2, bool))
    for i, j in ((0, 1), (1, 0)):
        known, own = laws[i]
        wanted = expected(known, own) - expected(known, laws[j][1])
        np.testing.assert_allclose(told.ratio[0, i, j], wanted, rtol=1e-5)
        if sd == 0:
            assert wanted > 1  # a Kullback-Leibler divergence
        aside = (laws[i][0][0] - laws[j][0][0]) @ np.linalg.solve(laws[j][1][1], laws[i][0][0] - laws[j][0][0]) / 2
        np.testing.assert_allclose(told.distance[0, i, j], aside, rtol=1e-5)
    assert told.finite.all()
    np.testing.assert_allclose(told.mean[0, 1].ravel(), laws[1][0][0], atol=1e-5)


def test_louder_process_noise_is_a_way_out(hypothesis: tuple[Setup, Any]) -> None:
    """A member that may call everything noise is harder to tell from another."""
    plan, program = hypothesis
    p = np.tile(plan.augmented.neutral, (2, 5, 1))
    p[1, :, [q.name for q in plan.augmented.params].index("load_v_c")] = 1.0
    q = jnp.asarray([[[0.0, 0.01], [0.0, 1.0]]] * 2)
    u = np.zeros((1, plan.lead + ROWS, 1))

    ratios = []
    for second in (-50.0, -2.0):
        members = Members(jnp.asarray(p), jnp.asarray(np.full((2, 2), 0.05)), q, jnp.array([[0.0, second]] * 2))
        told = program(
            members, jnp.asarray(u), jnp.zeros((1, 2)), jnp.asarray(SPREAD), jnp.zeros(2), jnp.zeros(2, bool)
        )
        ratios.append(float(told.ratio[0, 0, 1]))
    assert 0 < ratios[1] < 0.5 * ratios[0]


COULOMB = Expression(
    "coulomb_friction", acts_on="omega", term="-tau_c*tanh(omega/w)",
    parameters={"tau_c": {"range": [0, 2], "unit": "rad/s^2", "starts": [0.2]},
                "w": {"range": [0.005, 0.05], "unit": "rad/s", "neutral": 0.02, "starts": [0.02]}},
)  # fmt: skip
VISCOUS = Expression(
    "viscous_friction", acts_on="omega", term="-b*omega",
    parameters={"b": {"range": [0, 2], "unit": "1/s", "starts": [0.2]}},
)  # fmt: skip
STEP, NOISE = 0.05, 0.02


def pendulum() -> Any:
    return Declared(
        "pendulum", dt=STEP,
        states={"phi": {"unit": "rad", "range": [-3.15, 3.15], "periodic": True},
                "omega": {"unit": "rad/s", "range": [-8, 8]}},
        inputs={"u": {"unit": "V", "range": [-2, 2]}},
        parameters={"g_l": {"unit": "1/s^2", "range": [8, 12]}, "K": {"unit": "rad/s^2/V", "range": [0.8, 1.2]}},
        dynamics={"phi": "omega", "omega": "-g_l*sin(phi) + K*u"},
    ).model()  # fmt: skip


def swings(tau: float = 0.35, rows: int = 30) -> Recording:
    """Swings of the pendulum with dry friction, of nearly one size: weak data, on which any friction does."""
    random = np.random.default_rng(5)
    episodes = []
    for k in range(5):
        u = 1.0 * np.sin(3.1 * STEP * np.arange(rows) + random.uniform(0, 6))
        x, states = np.array([random.uniform(-0.3, 0.3), 0.0]), []
        for i in range(rows):
            states.append(x)
            for _ in range(20):
                rate = np.array([x[1], -9.8 * np.sin(x[0]) + u[i] - tau * np.tanh(x[1] / 0.01)])
                middle = x + STEP / 40 * rate
                x = x + STEP / 20 * np.array(
                    [middle[1], -9.8 * np.sin(middle[0]) + u[i] - tau * np.tanh(middle[1] / 0.01)]
                )
        measured = np.array(states) + NOISE * random.normal(size=(rows, 2)) * np.array([1.0, 3.0])
        episodes.append(Episode(f"{k}", np.arange(rows) * STEP, measured, u[:, None], np.zeros((rows, 0))))
    noise = {"phi": NOISE, "omega": 3 * NOISE}
    return Recording(tuple(episodes[:4]), tuple(episodes[4:]), (), noise, (), (Check("c", True, ""),), ())


@pytest.fixture(scope="module")
def tied() -> tuple[Search, Selection]:
    """Both frictions fitted, and called a tie."""
    plan = setup(pendulum(), swings(), (), [COULOMB, VISCOUS], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=4, width=8))
    base = search.base()
    effects = [t.effect for t in search.terms]
    trials = search.add(base, [effects.index("coulomb_friction"), effects.index("viscous_friction")]).trials
    chosen, rival = trials
    stages = (Stage(base, tuple(trials)),)
    return search, Selection(base, chosen, (base, chosen), ((rival,),), stages, (9.0,), None)


@pytest.fixture(scope="module")
def designed(tied: tuple[Search, Selection], tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("run")
    found = next_experiment(*tied, folder)
    assert found is not None
    return found, folder / FILE


def test_it_beats_admissible_episodes_drawn_at_random(
    tied: tuple[Search, Selection], designed: tuple[dict[str, Any], Path]
) -> None:
    search, selection = tied
    designer = Designer(search, class_of(search, selection))
    random = np.random.default_rng(11)
    drawn = [
        Proposal("held random signal", 1.0, float(random.uniform(1, 9)), None, int(random.integers(1000)), start)
        for start in random.uniform(designer.reach.low, designer.reach.high, (32, 2))
    ]
    least = [design.least for design in designer(drawn)]
    assert len(least) > 8
    best = designed[0]["expected_log_likelihood_ratio"]
    assert best >= max(least)
    assert best > 2 * np.median(least)


def test_the_file_is_an_episode_within_the_ranges(designed: tuple[dict[str, Any], Path]) -> None:
    found, path = designed
    table = pd.read_csv(path, comment="#")
    names = ("coulomb_friction", "viscous_friction")
    channels = {f"{channel}_if_{name}" for name in names for channel in ("phi", "omega")}
    assert set(table.columns) == {"time", "u", *channels}
    assert list(table.columns[:2]) == ["time", "u"]
    assert len(table) == 30
    np.testing.assert_allclose(np.diff(table["time"]), STEP)
    assert table["u"].abs().max() <= 2
    assert np.isfinite(table.to_numpy()).all()
    for name in names:
        assert table[f"omega_if_{name}"].abs().max() <= 8
        assert table[f"phi_if_{name}"][0] == pytest.approx(found["start"]["phi"], abs=1e-9)
    notes = [line for line in path.read_text().splitlines() if line.startswith("#")]
    assert found["description"] in notes[0]
    assert "phi = " in notes[1]


def test_the_verdict_says_what_to_do(designed: tuple[dict[str, Any], Path]) -> None:
    found, _ = designed
    assert found["kind"] in (FREE, *DRIVEN)
    assert {(p["true"], p["against"]) for p in found["pairs"]} == {
        ("coulomb_friction", "viscous_friction"), ("viscous_friction", "coulomb_friction")
    }  # fmt: skip
    least = min(p["expected_log_likelihood_ratio"] for p in found["pairs"])
    assert found["expected_log_likelihood_ratio"] == least
    assert f"{least:.0f} nats" in found["description"]
    assert "coulomb friction" in found["description"]
    assert "1.5 s" in found["description"]


def test_structural_twins_are_no_pair(tied: tuple[Search, Selection], tmp_path: Path) -> None:
    search, selection = tied
    twins = [t._replace(same_as=("viscous_friction",)) for t in search.terms]
    same = Search(search.plan, search.fitter)
    same.terms = tuple(twins)
    assert class_of(same, selection) == Class((), (), ())
    assert next_experiment(same, selection, tmp_path) is None
    assert not (tmp_path / FILE).exists()


@pytest.mark.parametrize("kind", DRIVEN)
@pytest.mark.parametrize("rows", [4, 60])
def test_signals_stay_within_their_ranges(kind: str, rows: int) -> None:
    inputs = (Quantity("u", "V", -1.0, 3.0), Quantity("valve", "1", 2.0, 5.0))
    for share, pace in ((1.0, 0.5), (-0.3, 50.0)):
        u = signal(Proposal(kind, share, pace, None, 3, np.zeros(1)), inputs, rows, 0.1)
        assert u.shape == (rows, 2)
        assert ((u >= [-1.0, 2.0]) & (u <= [3.0, 5.0])).all()
        assert (np.ptp(u, axis=0) > 0).all()
        one = signal(Proposal(kind, share, pace, 1, 3, np.zeros(1)), inputs, rows, 0.1)
        assert (one[:, 0] == 0).all()
