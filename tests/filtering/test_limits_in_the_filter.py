"""Readings that end at a level, actuators of limited rate and radiation, planted by integrators of the tests' own."""

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from linear_plant import DT, A, B, model, recording

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.trials import TIE, Search, Trial
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.likelihood.track import Noise
from simpel_cli.filtering.setup import Setup, setup
from simulators.effects import Expression
from simulators.model import Declared, Model

TOP, BOTTOM, NOISE, SLOWNESS = 0.9, -0.8, 0.01, 0.25
RADIATED = 0.004  # 1/s, of a linear loss at 300 K


def effect(name: str) -> Expression:
    return build(yaml.safe_load((conf_dir() / "effect" / f"{name}.yaml").read_text()), f"effect.{name}")


def clipped() -> Recording:
    """The linear plant with a sensor of v that ends at both sides."""

    def cut(e: Episode) -> Episode:
        return e._replace(states=np.stack([e.states[:, 0], np.clip(e.states[:, 1], BOTTOM, TOP)], -1))

    made = recording(2, NOISE)
    return made._replace(train=tuple(map(cut, made.train)), test=tuple(map(cut, made.test)))


def slow_actuator(seed: int = 3, fine: int = 500) -> Recording:
    """The linear plant behind an actuator that takes SLOWNESS s for one unit, in small steps."""
    random, made = np.random.default_rng(seed), recording(seed, NOISE)
    h, keep = DT / fine, np.exp(-A * DT / fine)

    def again(e: Episode) -> Episode:
        u, (s, v), states = e.inputs[:, 0], (0.0, 0.3), []
        at = u[0]
        for now in u:
            states.append([s, v])
            for _ in range(fine):
                at += np.clip(now - at, -h / SLOWNESS, h / SLOWNESS)
                end = B * at / A
                s, v = s + end * h + (v - end) * (1 - keep) / A, end + (v - end) * keep
        return e._replace(states=np.array(states) + NOISE * random.normal(size=(len(u), 2)))

    return made._replace(train=tuple(map(again, made.train)), test=tuple(map(again, made.test)))


def fitted(plan: Setup, name: str, place: str) -> tuple[Trial, Search, float, dict[str, float]]:
    """Return the fit with one effect, what it gains over none, and its parameters."""
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=3, width=9))
    base = search.base()
    (t,) = (i for i, term in enumerate(search.terms) if (term.effect, term.acts_on) == (name, place))
    (trial,) = search.add(base, [t]).trials
    values = {
        k.label: plan.coordinates.value(row, float(trial.optimum.z[row]))
        for k, row in zip(search.terms[t].parameters, search.rows[t], strict=True)
    }
    return trial, search, trial.optimum.log_evidence - base.optimum.log_evidence, values


@pytest.fixture(scope="module")
def ended() -> Setup:
    return setup(model(), clipped(), (), [effect("sensor_saturation")], 2)


def test_both_ends_of_a_sensor_are_found_and_the_plant_is_not_dragged(ended: Setup) -> None:
    trial, search, gain, values = fitted(ended, "sensor_saturation", "v")
    assert gain > 50
    assert values["top"] == pytest.approx(TOP, abs=0.03)
    assert values["bottom"] == pytest.approx(BOTTOM, abs=0.03)
    dragged, a, b = (
        ended.coordinates.value(i, float(t.optimum.z[i])) for t, i in ((search.base(), 1), (trial, 0), (trial, 1))
    )
    assert (a, b) == (pytest.approx(A, abs=0.1), pytest.approx(B, abs=0.1))
    assert dragged < B - 0.2


@pytest.mark.parametrize(("v", "moves"), [(1.5, False), (-1.2, False), (0.1, True)])
def test_a_reading_at_an_end_does_not_move_the_state(ended: Setup, *, v: float, moves: bool) -> None:
    """Where the state lies beyond an end by more than the linearisation sees, the filter goes on as without the reading."""
    names = [q.name for q in ended.augmented.params]
    p = ended.augmented.neutral.copy()
    p[:2] = A, B
    p[names.index("sensor_saturation_v_top")], p[names.index("sensor_saturation_v_bottom")] = TOP, BOTTOM
    rows = 3
    y = jnp.asarray(np.tile([0.0, np.clip(v, BOTTOM, TOP) + 0.2], (rows, 1)))
    ok = jnp.asarray(np.tile([0.0, 1.0], (rows, 1)))
    held = jnp.full((ended.lead + rows, 1), v * A / B)  # it stays where it is
    track, _ = ended.rule.track(
        jnp.asarray(p),
        Noise(jnp.full(2, 0.05), jnp.array([0.0, 0.1])),
        y,
        ok,
        held,
        jnp.array([0.0, v]),
        jnp.full(2, 0.3),
    )
    change = np.abs(np.asarray(track.mean - track.predicted)).max()
    assert change > 0.05 if moves else change == 0
    grown = np.asarray(track.cov - track.predicted_cov)
    assert (np.abs(grown).max() > 1e-3) == moves
    if not moves:
        np.testing.assert_allclose(track.variance[:, 1], 0.05**2, rtol=1e-12)


@pytest.fixture(scope="module")
def slowed() -> Setup:
    return setup(model(), slow_actuator(), (), [effect("actuator_rate_limit"), effect("input_lag")], 2)


def test_a_largest_rate_is_found_before_a_lag(slowed: Setup) -> None:
    _, search, gain, values = fitted(slowed, "actuator_rate_limit", "u")
    assert values["s"] == pytest.approx(SLOWNESS, rel=0.03)
    base = search.base()
    (lag,) = (i for i, term in enumerate(search.terms) if term.effect == "input_lag")
    (other,) = search.add(base, [lag]).trials
    assert gain > other.optimum.log_evidence - base.optimum.log_evidence + 20
    assert gain > 50


def test_the_derivative_in_a_largest_rate_is_that_of_a_difference(slowed: Setup) -> None:
    row = [q.name for q in slowed.augmented.params].index("actuator_rate_limit_u_s")
    coordinates, rule = slowed.coordinates, slowed.rule
    y, ok, u, start, spread = (jnp.asarray(a[0]) for a in slowed.windows[:5])
    at = jnp.asarray(slowed.start).at[row].set(coordinates.unit(row, 0.11))
    p, noise = coordinates.physical(at)
    track, held = rule.track(p, noise, y, ok, u, start, spread)
    ways, pushes = rule.pushes(p, jnp.array([row]), track, held, u)
    quiet = Noise(jnp.zeros((1, 2)), jnp.zeros((1, len(noise.q))))
    (_, found), _ = rule.slopes(p, noise, quiet, track, held, ok, ways, pushes)

    def innovation(s: float) -> np.ndarray:
        return np.asarray(rule.track(p.at[row].set(s), noise, y, ok, u, start, spread)[0].innovation)

    difference = (innovation(0.11 + 1e-6) - innovation(0.11 - 1e-6)) / 2e-6
    assert np.abs(difference).max() > 0.1
    np.testing.assert_allclose(found, difference, rtol=1e-5, atol=1e-6)


def oven() -> Model:
    return Declared(
        "oven", dt=10.0, states={"T": {"unit": "degC", "range": [0, 600], "role": "temperature"}},
        inputs={"u": {"unit": "1", "range": [0, 1]}},
        parameters={"k_h": {"unit": "degC/s", "range": [2, 6]}, "a": {"unit": "1/s", "range": [0.001, 0.02]}},
        dynamics={"T": "k_h*u - a*(T - 20)"},
    ).model()  # fmt: skip


def radiating(fine: int = 200) -> Recording:
    """An oven that loses heat by convection and by radiation, in small steps."""
    random, episodes = np.random.default_rng(4), []
    for k in range(5):
        u, temperature, states = np.repeat(random.uniform(0, 1, 8), 5), random.uniform(20, 300), []
        for now in u:
            states.append(temperature)
            for _ in range(fine):
                kelvin = temperature + 273.15
                lost = 0.006 * (temperature - 20) + RADIATED * (kelvin**4 - 293.15**4) / (4 * 300.0**3)
                temperature += (4.0 * now - lost) * 10.0 / fine
        read = np.array(states)[:, None] + 0.5 * random.normal(size=(len(u), 1))
        episodes.append(Episode(f"{k}", 10.0 * np.arange(len(u)), read, u[:, None], np.zeros((len(u), 0))))
    check = (Check("c", True, ""),)
    return Recording(tuple(episodes[:4]), tuple(episodes[4:]), (), {"T": 0.5}, (), check, ())


def test_what_an_oven_radiates_is_found_before_a_loss_with_the_square() -> None:
    plan = setup(oven(), radiating(), (), [effect("radiation"), effect("crowding"), effect("ambient_exchange")], 4)
    _, search, gain, values = fitted(plan, "radiation", "T")
    base = search.base()
    others = [i for i, term in enumerate(search.terms) if term.effect in ("crowding", "ambient_exchange")]
    trials = search.add(base, others).trials
    assert values["k"] == pytest.approx(RADIATED, rel=0.15)
    assert gain > TIE + max(t.optimum.log_evidence for t in trials) - base.optimum.log_evidence
    assert gain > 100
