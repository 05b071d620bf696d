"""Planted times (late and slow sensors, clocks, jitter, inputs between rows) against exact solutions of a linear system."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.linalg import expm
from test_racecar import car
from test_simulate import decay, late_model, static, world_of

from simulators.model import Declared, Model, ModelError
from simulators.worlds.callable_world import CallableWorld
from simulators.worlds.groups import Group, Spread
from simulators.worlds.motion import Inputs
from simulators.worlds.simulate import Simulate, Simulation
from simulators.worlds.timing import Clock

A = np.array([[0.0, 1.0], [-20.0, -0.8]])
B = np.array([[0.0, 0.0], [3.0, -2.0]])
START = np.array([0.4, -1.0])
FROM = {"x": [0.4, 0.4], "v": [-1.0, -1.0]}


def spring(delays: tuple[float, float] = (0.0, 0.0), substeps: int = 20) -> Model:
    """x' = v, v' = -20 x - 0.8 v + 3 u - 2 w, seen also through q = x + 2 w."""
    return Declared(
        "spring", dt=0.05, substeps=substeps,
        states={"x": {"unit": "m", "range": [-1, 1]}, "v": {"unit": "m/s", "range": [-5, 5]}},
        inputs={n: {"unit": "N", "range": [-1, 1], "delay": d} for n, d in zip(("u", "w"), delays, strict=True)},
        dynamics={"x": "v", "v": "-20*x - 0.8*v + 3*u - 2*w"},
        outputs={"q": {"unit": "m", "expression": "x + 2*w"}},
    ).model()  # fmt: skip


def signal(times: np.ndarray, values: np.ndarray, t: float, linear: bool) -> tuple[float, float]:
    """Return a signal and its slope right after t, from the rows in which it is given."""
    j = int(np.searchsorted(times, t + 1e-12, side="right")) - 1
    if j < 0:
        return values[0], 0.0
    if not linear or j == len(times) - 1:
        return values[j], 0.0
    slope = (values[j + 1] - values[j]) / (times[j + 1] - times[j])
    return values[j] + slope * (t - times[j]), slope


def exact(
    times: np.ndarray, inputs: np.ndarray, linear: tuple[bool, bool], delays: tuple[float, float], wanted: np.ndarray
) -> np.ndarray:
    """Return the states at the wanted times: matrix exponentials of the states, the inputs and their slopes."""
    whole = np.zeros((6, 6))
    whole[:2, :2], whole[:2, 2:4], whole[2:4, 4:] = A, B, np.eye(2)
    knots = np.unique(np.concatenate([[0.0], wanted, *(times + d for d in delays)]))
    x, now, found = START, 0.0, {0.0: START}
    for t in knots[(knots > 0) & (knots <= wanted.max())]:
        known = [signal(times, inputs[:, i], now - delays[i], linear[i]) for i in range(2)]
        z = np.concatenate([x, *zip(*known, strict=True)])
        x = (expm(whole * (t - now)) @ z)[:2]
        now = t
        found[t] = x
    return np.array([found[t] for t in wanted])


def run(source: Any = None, **how: Any) -> Simulation:
    how = {"episodes": 2, "steps": 40, "seed": 3, "initial": FROM, "test_fraction": 0} | how
    return Simulate(**how).run(source or spring())


def rows_of(made: Simulation, episode: int = 0) -> dict[str, np.ndarray]:
    return {name: values[made.columns["episode"] == episode] for name, values in made.columns.items()}


def inputs_of(rows: dict[str, np.ndarray]) -> np.ndarray:
    return np.column_stack([rows["u"], rows["w"]])


@pytest.mark.parametrize("delays", [(0.0, 0.0), (0.013, 0.12)])
@pytest.mark.parametrize("between", [{"u": "linear", "w": "linear"}, {"u": "linear"}, {"u": "held", "w": "linear"}])
def test_linear_inputs_act_as_the_matrix_exponential_says(between: dict[str, str], delays: tuple[float, float]) -> None:
    made = run(spring(delays), between_rows=between)
    rows, linear = rows_of(made, 1), (between.get("u") == "linear", between.get("w") == "linear")
    found = np.column_stack([rows["x"], rows["v"]])
    np.testing.assert_allclose(found, exact(rows["t"], inputs_of(rows), linear, delays, rows["t"]), atol=1e-6)
    felt = [signal(rows["t"], rows["w"], t - delays[1], linear[1])[0] for t in rows["t"]]
    np.testing.assert_allclose(rows["q"], rows["x"] + 2 * np.array(felt), atol=1e-9)  # as it arrives
    held = run(spring(delays))
    np.testing.assert_array_equal(held.columns["u"], made.columns["u"])
    assert np.abs(held.columns["x"] - made.columns["x"]).max() > 1e-3
    assert made.card["between_rows"] == between


def test_a_late_sensor_records_what_was() -> None:
    """x 12 ms late, v 70 ms, q in time: the rows begin two rows after the motion, and the inputs are those of their row."""
    made = run(latency={"x": 0.012, "v": 0.07})
    rows, whole = rows_of(made), rows_of(run(steps=42))
    np.testing.assert_allclose(rows["t"], 0.05 * np.arange(2, 42), rtol=1e-12)
    np.testing.assert_array_equal(rows["u"], whole["u"][2:])
    inputs = inputs_of(whole)
    for name, i, late in (("x", 0, 0.012), ("v", 1, 0.07)):
        then = exact(whole["t"], inputs, (False, False), (0.0, 0.0), rows["t"] - late)[:, i]
        np.testing.assert_allclose(rows[name], then, atol=1e-6)
    np.testing.assert_allclose(rows["q"], whole["q"][2:], atol=1e-6)
    assert made.card["latency"] == {"x": 0.012, "v": 0.07}
    late = rows_of(run(latency={"q": 0.03}, between_rows={"w": "linear"}))
    x = exact(whole["t"], inputs, (False, True), (0.0, 0.0), late["t"] - 0.03)[:, 0]
    w = np.interp(late["t"] - 0.03, whole["t"], whole["w"])
    np.testing.assert_allclose(late["q"], x + 2 * w, atol=1e-6)


def test_rows_with_jitter_lie_on_the_motion() -> None:
    made = run(jitter=0.3, steps=60)
    rows, steps = rows_of(made), rows_of(run(steps=60))["t"]
    away = (rows["t"] - steps) / 0.05
    assert away[0] == 0  # the motion begins there
    assert 0.25 < np.abs(away).max() <= 0.3
    assert (np.diff(rows["t"]) > 0).all()
    assert (rows_of(made, 1)["t"] != rows["t"])[1:].all()
    for linear in (False, True):
        each = rows_of(run(jitter=0.3, steps=60, between_rows=dict.fromkeys("uw", "linear" if linear else "held")))
        np.testing.assert_array_equal(each["t"], rows["t"])
        found = exact(each["t"], inputs_of(each), (linear, linear), (0.0, 0.0), each["t"])
        np.testing.assert_allclose(np.column_stack([each["x"], each["v"]]), found, atol=1e-6)
    longer = rows_of(run(jitter=0.3, steps=90))
    np.testing.assert_array_equal(longer["t"][:60], rows["t"])


def test_a_slow_sensor_speaks_in_some_rows() -> None:
    made, whole = run(rates={"x": 0.2}), run()
    spoke = np.arange(80) % 40 % 4 == 0
    np.testing.assert_array_equal(np.isnan(made.columns["x"]), ~spoke)
    np.testing.assert_array_equal(made.columns["x"][spoke], whole.columns["x"][spoke])
    np.testing.assert_array_equal(made.columns["v"], whole.columns["v"])
    assert made.card["rates"] == {"x": 0.2}


def test_a_clock_of_its_own_adds_rows() -> None:
    clock = Clock(offset=0.003, drift=1e-2)
    made = run(rates={"x": 0.1}, clocks={"x": clock}, between_rows={"u": "linear"})
    rows, whole = rows_of(made), rows_of(run())
    samples = 0.003 + 0.101 * np.arange(20)
    np.testing.assert_allclose(rows["t"][~np.isnan(rows["x"])], samples[samples <= 39 * 0.05], rtol=1e-12)
    np.testing.assert_allclose(rows["t"][~np.isnan(rows["v"])], whole["t"], rtol=1e-12)
    np.testing.assert_array_equal(np.isnan(rows["v"]), ~np.isnan(rows["x"]))  # no sample falls on a row
    then = exact(whole["t"], inputs_of(whole), (True, False), (0.0, 0.0), rows["t"])
    np.testing.assert_allclose(rows["x"][~np.isnan(rows["x"])], then[~np.isnan(rows["x"]), 0], atol=1e-6)
    np.testing.assert_allclose(rows["v"][~np.isnan(rows["v"])], then[~np.isnan(rows["v"]), 1], atol=1e-6)
    np.testing.assert_allclose(rows["u"], np.interp(rows["t"], whole["t"], whole["u"]), atol=1e-9)
    held = whole["w"][np.searchsorted(whole["t"], rows["t"] + 1e-9, side="right") - 1]
    np.testing.assert_array_equal(rows["w"], held)  # as the plant sees them
    assert made.card["clocks"] == {"x": {"offset": 0.003, "drift": 0.01}}


def test_clocks_that_agree_share_their_rows() -> None:
    made = run(clocks={"x": Clock(0.02), "v": Clock(0.02), "q": Clock()})
    rows = rows_of(made)
    assert len(rows["t"]) == 40 + 39
    np.testing.assert_array_equal(np.isnan(rows["x"]), np.isnan(rows["v"]))
    np.testing.assert_array_equal(np.isnan(rows["x"]), ~np.isnan(rows["q"]))


def test_all_at_once_with_noise_groups_split_and_what_is_not_measured() -> None:
    how: dict[str, Any] = {
        "latency": {"x": 0.012}, "rates": {"x": 0.1}, "clocks": {"x": Clock(0.004)}, "jitter": 0.2,
        "between_rows": {"u": "linear", "w": "linear"}, "unmeasured": ("v",), "test_fraction": 0.5,
        "groups": {"rig": Group(2)},
    }  # fmt: skip
    source = spring((0.0, 0.03))
    clean = run(source, **how)
    rows = rows_of(clean, 1)
    given = ~np.isnan(rows["q"])
    assert [*rows] == ["episode", "t", "rig", "x", "u", "w", "q", "split"]
    assert set(rows["split"]) == {"test"}
    assert set(rows["rig"]) == {"rig_1"}
    # the inputs before the first row are not recorded: those of a run without latency, whose rows begin with the motion
    base = rows_of(run(source, **(how | {"latency": {}, "rates": {}, "clocks": {}, "steps": 41})), 1)
    np.testing.assert_allclose(base["t"][1:], rows["t"][given], rtol=1e-12)
    spoke = ~np.isnan(rows["x"])
    x = exact(base["t"], inputs_of(base), (True, True), (0.0, 0.03), rows["t"][spoke] - 0.012)[:, 0]
    np.testing.assert_allclose(rows["x"][spoke], x, atol=1e-6)
    noisy = run(source, **how, noise_std={"x": 0.01, "q": 0.01}, missing={"q": 0.2}, quantisation={"x": 0.005})
    noise = (noisy.columns["x"] - clean.columns["x"])[~np.isnan(clean.columns["x"])]
    assert 0.005 < noise.std() < 0.02
    assert np.isnan(noisy.columns["q"]).sum() > np.isnan(clean.columns["q"]).sum()
    assert yaml.safe_load(yaml.safe_dump(noisy.card)) == noisy.card


def test_what_nobody_measures_adds_no_rows_and_no_wait() -> None:
    made = run(latency={"x": 0.07}, clocks={"x": Clock(0.01)}, unmeasured=("x",))
    np.testing.assert_allclose(rows_of(made)["t"], 0.05 * np.arange(40), rtol=1e-12)
    assert not made.card.keys() & {"latency", "clocks"}


def later(source: Any, **how: Any) -> None:
    """A latency of one row: every state of a row is that of the row before, integrated from row to row."""
    how = {"episodes": 2, "seed": 5, "test_fraction": 0} | how
    late = Simulate(**how, steps=20, latency={q.name: source.dt for q in source.states}).run(source).columns
    plain = Simulate(**how, steps=21).run(source).columns
    for q in source.states:
        before = plain[q.name].reshape(2, 21)[:, :-1]
        np.testing.assert_allclose(late[q.name].reshape(2, 20), before, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(late["t"], plain["t"].reshape(2, 21)[:, 1:].ravel())


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_coordinates_of_a_models_own_and_late_inputs(fidelity: str) -> None:
    """A car is integrated in its own frame."""
    start = {"vx": [1.0, 1.0], "vy": [0.0, 0.0], "omega": [0.0, 0.0]}
    later(replace(car(fidelity), substeps=20), initial=start)


def test_delays_of_groups_and_limits() -> None:
    later(late_model(0.1, 0.25), groups={"rig": Group(2, {"d": Spread(0.3, "lognormal")})})
    later(decay(states={"c": {"unit": "mol", "range": [1, 2], "limits": [0.5, 2.0]}}))


def test_a_world_is_late_by_whole_time_steps() -> None:
    """MuJoCo queried within a row answers as it does when rows are that short; commands on their way stay what they are."""
    world = world_of("pendulum_world.yaml")
    step = world.spec.option.timestep
    how: dict[str, Any] = {"episodes": 2, "seed": 5, "test_fraction": 0}
    made = Simulate(**how, steps=10, latency={"phi": 3 * step}, rates={"omega": 2 * world.dt}).run(world).columns
    plain = Simulate(**how, steps=11).run(world).columns
    for k in range(2):
        x = np.column_stack([plain["phi"], plain["omega"]])[11 * k : 11 * k + 10]
        u = plain["u"][11 * k : 11 * k + 10, None]
        params = np.tile(_truth(world, how), (10, 1))
        expected = world.shorter(world.dt - 3 * step).step(x, u, params)[:, 0]
        phi = made["phi"][10 * k : 10 * k + 10]
        np.testing.assert_allclose(np.sin(phi - expected), 0, atol=1e-9)
        assert np.abs(np.sin(phi - x[:, 0])).max() > 1e-4
    assert np.isnan(made["omega"]).sum() == 10
    with pytest.raises(
        ModelError, match=r"simulation\.latency: pendulum_world is asked .* no whole number of MuJoCo's"
    ):
        Simulate(**how, steps=5, latency={"phi": 0.3 * step}).run(world)


def test_a_world_has_sensors_with_clocks_of_whole_time_steps() -> None:
    world = world_of("pendulum_world.yaml")
    made = Simulate(episodes=1, steps=6, test_fraction=0, clocks={"phi": Clock(world.spec.option.timestep)}).run(world)
    rows = rows_of(made)
    assert np.isfinite(rows["phi"]).sum() == 5
    np.testing.assert_array_equal(np.isnan(rows["phi"]), np.isfinite(rows["omega"]))
    first, second = rows["phi"][1], rows["omega"][0]
    initial = Simulate(episodes=1, steps=6, test_fraction=0).run(world).columns["phi"][0]
    assert abs(np.angle(np.exp(1j * (first - initial - second * rows["t"][1])))) < 1e-3


def lagged() -> Model:
    return decay(inputs={"u": {"unit": "V", "range": [-1, 3], "lag": 0.2}}, outputs={})


def _truth(world: Any, how: dict[str, Any]) -> np.ndarray:
    truth = Simulate(**how, steps=1).run(world).card["truth"]
    return np.array([truth[q.name] for q in world.params])


def test_a_world_within_a_row_keeps_commands_on_their_way() -> None:
    world = world_of("rc_car_world.yaml")
    first = np.array([[(q.low + q.high) / 2 for q in world.states]])
    on_the_way = [i for i, q in enumerate(world.states) if q.name[-1].isdigit()]
    first[:, on_the_way] = 0.1 * np.arange(1, len(on_the_way) + 1)
    params = np.array([[q.middle for q in world.params]])
    step = world.spec.option.timestep
    part = world.shorter(step).step(first, np.ones((1, len(world.inputs))), params)
    np.testing.assert_array_equal(part[:, on_the_way], first[:, on_the_way])
    assert np.isfinite(part).all()
    whole = world.shorter(world.dt).step(first, np.ones((1, len(world.inputs))), params)
    np.testing.assert_array_equal(whole, world.step(first, np.ones((1, len(world.inputs))), params))


def test_a_function_as_a_world_is_late_by_whole_rows() -> None:
    half = CallableWorld("half", 0.1, lambda x, u, p: x / 2, states={"x": {"range": [0, 1]}}).model()
    made = Simulate(episodes=1, steps=5, latency={"x": 0.2}, test_fraction=0).run(half).columns
    np.testing.assert_allclose(made["x"][1:], made["x"][:-1] / 2)
    np.testing.assert_allclose(made["t"], [0.2, 0.3, 0.4, 0.5, 0.6])
    with pytest.raises(ModelError, match=r"simulation\.latency: half answers every 0\.1 s only; give a whole number"):
        Simulate(episodes=2, steps=5, latency={"x": 0.15}).run(half)


@pytest.mark.parametrize(
    ("source", "how", "fragment"),
    [
        (decay, {"latency": {"c": -1}}, r"simulation\.latency\.c: -1 s is not allowed; give 0 s or more"),
        (decay, {"latency": {"u": 1}}, r"simulation\.latency\.u: no such name; known: c, q"),
        (decay, {"rates": {"c": 0}}, r"simulation\.rates\.c: 0 s is not allowed"),
        (decay, {"rates": {"c": 0.15}}, r"simulation\.rates\.c: 0\.15 s is no whole number of rows of 0\.1 s; .*clocks\.c="),
        (decay, {"rates": {"c": 0.01}}, r"simulation\.rates\.c: 0\.01 s is no whole number of rows"),
        (decay, {"rates": {"c": 5}, "latency": {"q": 0.1}}, r"simulation\.rates\.c: no sample in 5 rows"),
        (decay, {"clocks": {"c": Clock(9)}}, r"simulation\.clocks\.c: no sample between the first row, 0 s"),
        (decay, {"clocks": {"c": Clock(0, -1)}}, r"simulation\.clocks\.c: offset = 0 s, drift = -1 is not allowed"),
        (decay, {"jitter": 0.5}, r"simulation\.jitter: 0\.5 is not allowed; give 0 <= share < 0\.5"),
        (decay, {"between_rows": {"u": "lineal"}}, r"between_rows\.u: 'lineal' is not allowed.* Did you mean linear\?"),
        (decay, {"between_rows": {"c": "linear"}}, r"simulation\.between_rows\.c: no such name; known: u"),
        (decay, {"layout": "transitions", "latency": {"c": 0.1}}, r"simulation\.latency: rows of .* do not follow each other"),
        (decay, {"layout": "transitions", "drift": {"k": 0.1}}, r"simulation\.drift: rows of layout transitions"),
        (decay, {"layout": "transitions", "between_rows": {"u": "linear"}}, r"simulation\.between_rows: rows of layout"),
        (static, {"jitter": 0.1}, r"simulation\.jitter: line has no states, so its rows have no time; leave it out"),
        (lambda: late_model(0.1, 0.2), {"drift": {"d": 0.1}}, r"simulation\.drift\.d: it is a delay of an input"),
        (
            lambda: decay(dynamics={"c": "c**3"}), {"jitter": 0.1},
            r"simulation: c of decay is \S+ at t = \d.* s of episode 0; narrow simulation\.initial",
        ),
        (lambda: lagged(), {"jitter": 0.1}, r"sim\.inputs\.u\.lag: .* cannot lag inputs"),
        (
            lambda: world_of("pendulum_world.yaml"), {"clocks": {"phi": Clock(1e-5)}},
            r"simulation\.clocks: pendulum_world is asked .* no whole number",
        ),
        (lambda: world_of("pendulum_world.yaml"), {"jitter": 0.1}, r"simulation\.jitter: pendulum_world is a world"),
        (lambda: world_of("pendulum_world.yaml"), {"drift": {"m": 0.1}}, r"simulation\.drift: pendulum_world is a world"),
        (
            lambda: world_of("pendulum_world.yaml"), {"between_rows": {"u": "linear"}},
            r"simulation\.between_rows: pendulum_world is a world",
        ),
    ],
)  # fmt: skip
def test_errors_name_the_key_and_the_cure(source: Any, how: dict[str, Any], fragment: str) -> None:
    with pytest.raises(ModelError, match=fragment):
        Simulate(**({"episodes": 2, "steps": 5} | how)).run(source())


@pytest.mark.parametrize("late", [{"delay": 0.1}, {"lag": 0.1}])
def test_rows_without_time_have_no_late_inputs(late: dict[str, float]) -> None:
    model = Declared(
        "line", dt=0.1, inputs={"u": {"unit": "V", "range": [-1, 1], **late}},
        outputs={"y": {"unit": "V", "expression": "2*u"}},
    ).model()  # fmt: skip
    with pytest.raises(ModelError, match=rf"sim.inputs.u.{next(iter(late))}: line has no states"):
        Simulate(episodes=1, steps=5).run(model)


@pytest.mark.parametrize("stray", [0.0, 0.3])
def test_smooth_inputs_pass_through_their_rows_and_follow_a_cubic(stray: float) -> None:
    """Slopes through five rows are exact of polynomials up to the fourth degree; beside them others stay what they are."""
    random = np.random.default_rng(0)
    times = (np.arange(12.0) + stray * random.uniform(-0.5, 0.5, 12))[None]
    cubic = 0.01 * (times - 4) ** 3 - 0.2 * times
    values = np.stack([cubic, cubic, cubic], axis=2)
    given = Inputs.of_rows(times, values, ("smooth", "linear", "held"))
    np.testing.assert_allclose(given.at(times, 1e-9), values, atol=1e-9)
    within = np.linspace(times[0, 2], times[0, -3], 400)[
        None
    ]  # nearer to the ends a parabola stands for what is beyond
    found = given.at(within, 1e-9)[0]
    np.testing.assert_allclose(found[:, 0], 0.01 * (within[0] - 4) ** 3 - 0.2 * within[0], atol=1e-3)
    np.testing.assert_allclose(found[:, 1], np.interp(within[0], times[0], cubic[0]), atol=1e-9)
    assert set(np.round(found[:, 2], 9)) <= set(np.round(cubic[0], 9))
    assert given.linear.tolist() == [True, True, False]
