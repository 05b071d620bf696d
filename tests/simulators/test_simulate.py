"""Simulated measurements: closed forms, independent streams, noise, split, card, and what a user may get wrong."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.stats import kstest

from simulators.model import Declared, Model, ModelError, Quantity
from simulators.worlds.excitation import Excitation, HeldRandom, Multisine, OrnsteinUhlenbeck, Zero
from simulators.worlds.mujoco_world import MujocoWorld
from simulators.worlds.rk4 import RK4
from simulators.worlds.simulate import Simulate

CONF = Path(__file__).parents[2] / "conf" / "sim"
U = Quantity("u", "V", -1.0, 3.0)


def decay(**changes: Any) -> Model:
    """c' = -k c + b u, measured also through q = 2 c + u."""
    node: dict[str, Any] = {
        "name": "decay",
        "dt": 0.1,
        "states": {"c": {"unit": "mol", "range": [1, 2]}},
        "inputs": {"u": {"unit": "V", "range": [-1, 3]}},
        "parameters": {"k": {"unit": "1/s", "range": [0.5, 2]}, "b": {"unit": "mol/s/V", "range": [0, 1]}},
        "dynamics": {"c": "-k*c + b*u"},
        "outputs": {"q": {"unit": "C", "expression": "2*c + u"}},
    }
    return Declared(**(node | changes)).model()


def turntable() -> Model:
    """An angle that runs through many turns."""
    return Declared(
        "turntable",
        dt=0.1,
        states={"a": {"unit": "rad", "range": [-3, 3], "periodic": True}, "w": {"unit": "rad/s", "range": [8, 9]}},
        dynamics={"a": "w", "w": "0"},
    ).model()


def static() -> Model:
    return Declared(
        "line",
        dt=1,
        inputs={"x": {"unit": "1", "range": [-5, 5]}},
        parameters={"a": {"unit": "1", "range": [1, 2], "prior": "normal"}},
        outputs={"f": {"unit": "m", "expression": "a*x + 1"}},
    ).model()


def world_of(file: str) -> Any:
    node = yaml.safe_load((CONF / file).read_text())
    del node["_target_"]
    return MujocoWorld(**node).model()


def test_the_free_decay_is_the_closed_form() -> None:
    columns, card = Simulate(episodes=3, steps=30, excitation=Zero(), truth={"k": 1.3}).run(decay())
    t, c = columns["t"].reshape(3, 30), columns["c"].reshape(3, 30)
    np.testing.assert_allclose(t[1], 0.1 * np.arange(30))
    np.testing.assert_allclose(c, c[:, :1] * np.exp(-1.3 * t), rtol=1e-8)
    assert ((c[:, 0] >= 1) & (c[:, 0] <= 2)).all()
    assert len(set(c[:, 0])) == 3
    np.testing.assert_array_equal(columns["episode"], np.repeat([0, 1, 2], 30))
    assert card["truth"]["k"] == 1.3


def test_an_input_acts_from_its_row_to_the_next_and_outputs_belong_to_their_row() -> None:
    columns, card = Simulate(episodes=1, steps=20, test_fraction=0).run(decay())
    k, b = card["truth"]["k"], card["truth"]["b"]
    c, u = columns["c"], columns["u"]
    keep = np.exp(-k * 0.1)
    np.testing.assert_allclose(c[1:], keep * c[:-1] + (1 - keep) * b / k * u[:-1], rtol=1e-7)
    np.testing.assert_allclose(columns["q"], 2 * c + u, rtol=1e-12)
    assert "split" not in columns


def test_rk4_converges_at_order_four() -> None:
    errors = []
    for substeps in (1, 2):
        after = RK4(decay(substeps=substeps)).step(np.ones((1, 1)), np.zeros((1, 1)), np.array([[2.0, 0.0]]))
        errors.append(abs(after[0, 0] - np.exp(-0.2)))
    assert 14 < errors[0] / errors[1] < 18


def test_rk4_answers_each_query_with_its_own_parameters() -> None:
    k = np.array([[0.5, 0.0], [1.0, 0.0], [2.0, 0.0]])
    after = RK4(decay()).step(np.full((3, 1), 1.5), np.zeros((3, 1)), k)
    np.testing.assert_allclose(after[:, 0], 1.5 * np.exp(-0.1 * k[:, 0]), rtol=1e-9)


@pytest.mark.parametrize("source", [decay(), static(), turntable(), world_of("pendulum_world.yaml")])
def test_the_seed_decides_everything(source: Any) -> None:
    noise = {q.name: 0.1 for q in (*source.states, *source.outputs)}

    def run(seed: int) -> dict[str, np.ndarray]:
        return Simulate(episodes=2, steps=4, seed=seed, noise_std=noise).run(source).columns

    first, again, other = run(5), run(5), run(6)
    for name, values in first.items():
        np.testing.assert_array_equal(again[name], values)
        if name not in ("episode", "t", "split"):
            assert (other[name] != values).all()


def test_more_episodes_and_longer_ones_leave_the_first_as_they_were() -> None:
    noise, source = {"c": 0.1, "q": 0.1}, decay()
    small = Simulate(episodes=3, steps=10, noise_std=noise, test_fraction=0).run(source)
    more = Simulate(episodes=5, steps=10, noise_std=noise, test_fraction=0).run(source)
    longer = Simulate(episodes=3, steps=17, noise_std=noise, test_fraction=0).run(source)
    for name in ("c", "u", "q"):
        np.testing.assert_array_equal(more.columns[name][:30], small.columns[name])
        np.testing.assert_array_equal(longer.columns[name].reshape(3, 17)[:, :10], small.columns[name].reshape(3, 10))
    assert more.card["truth"] == longer.card["truth"] == small.card["truth"]


def test_a_given_parameter_leaves_the_other_draws_as_they_were() -> None:
    free = Simulate(episodes=2, steps=5).run(decay())
    given = Simulate(episodes=2, steps=5, truth={"k": 0.7}).run(decay())
    assert given.card["truth"] == {"k": 0.7, "b": free.card["truth"]["b"]}
    np.testing.assert_array_equal(given.columns["u"], free.columns["u"])


def test_noise_is_white_gaussian_independent_and_not_fed_back() -> None:
    std = {"c": 0.3, "q": 0.05}
    clean = Simulate(episodes=10, steps=400).run(decay()).columns
    noisy = Simulate(episodes=10, steps=400, noise_std=std).run(decay()).columns
    np.testing.assert_array_equal(noisy["u"], clean["u"])
    noise = {name: (noisy[name] - clean[name]) / std[name] for name in std}
    for values in noise.values():
        assert abs(values.std() - 1) < 0.1
        assert kstest(values, "norm").pvalue > 1e-3
        assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 4 / np.sqrt(4000)
    assert abs(np.corrcoef(noise["c"], noise["q"])[0, 1]) < 4 / np.sqrt(4000)
    assert abs(np.corrcoef(noise["c"].reshape(10, 400)[:2])[0, 1]) < 4 / np.sqrt(400)


def test_angles_are_wrapped_after_the_noise() -> None:
    columns = Simulate(episodes=2, steps=60, noise_std={"a": 0.2}).run(turntable()).columns
    a, w = columns["a"].reshape(2, 60), columns["w"].reshape(2, 60)
    assert a.min() >= -np.pi
    assert a.max() < np.pi
    turned = np.angle(np.exp(1j * (a - a[:, :1] - w * 0.1 * np.arange(60))))  # the noise of the row and of the first
    assert 0 < np.abs(turned).max() < 1.5


@pytest.mark.parametrize(("episodes", "fraction", "n_test"), [(8, 0.25, 2), (3, 0.01, 1), (2, 0.9, 1), (10, 0.5, 5)])
def test_the_last_episodes_are_the_test(episodes: int, fraction: float, n_test: int) -> None:
    columns = Simulate(episodes=episodes, steps=3, test_fraction=fraction).run(decay()).columns
    expected = np.where(columns["episode"] >= episodes - n_test, "test", "train")
    np.testing.assert_array_equal(columns["split"], expected)


def test_a_static_model_gives_rows_of_inputs_and_outputs() -> None:
    columns, card = Simulate(episodes=1, steps=2000, noise_std={"f": 0.2}).run(static())
    assert list(columns) == ["x", "f", "split"]
    assert kstest(columns["x"], "uniform", (-5, 10)).pvalue > 1e-3
    assert abs((columns["f"] - card["truth"]["a"] * columns["x"] - 1).std() / 0.2 - 1) < 0.1
    assert (columns["split"] == "test").sum() == 500
    assert "excitation" not in card


def test_initial_ranges() -> None:
    columns = Simulate(episodes=40, steps=1, initial={"c": [7, 7.5]}).run(decay()).columns
    assert columns["c"].min() >= 7
    assert 7.3 < columns["c"].max() <= 7.5


def test_the_card_says_how_the_data_were_made_in_plain_yaml() -> None:
    how = Simulate(episodes=2, steps=5, seed=4, noise_std={"c": 0.1}, excitation=HeldRandom(0.1, 0.2))
    card = how.run(decay()).card
    assert yaml.safe_load(yaml.safe_dump(card)) == card
    assert card["columns"] == {"t": {"unit": "s"}, "c": {"unit": "mol"}, "u": {"unit": "V"}, "q": {"unit": "C"}}
    assert card["excitation"] == {"law": "HeldRandom", "shortest": 0.1, "longest": 0.2}
    assert card["noise_std"] == {"c": 0.1, "q": 0.0}
    assert card["initial"] == {"c": [1.0, 2.0]}
    assert (card["source"], card["seed"], card["dt"]) == ("decay", 4, 0.1)
    assert 0.5 <= card["truth"]["k"] <= 2
    assert "truth" not in Simulate(episodes=2, steps=5, hide_truth=True).run(decay()).card


def test_what_is_not_measured_has_no_column_and_is_not_on_the_card() -> None:
    everything = Simulate(episodes=2, steps=9, noise_std={"c": 0.1, "q": 0.2}).run(decay())
    columns, card = Simulate(episodes=2, steps=9, noise_std={"c": 0.1, "q": 0.2}, unmeasured=("c",)).run(decay())
    assert list(columns) == ["episode", "t", "u", "q", "split"]
    np.testing.assert_array_equal(columns["q"], everything.columns["q"])
    assert card["noise_std"] == {"q": 0.2}
    assert card["initial"] == {}
    assert list(card["columns"]) == ["t", "u", "q"]


def test_the_card_begins_with_the_description_if_there_is_one() -> None:
    card = Simulate(episodes=2, steps=5, description="A tank that drains.").run(decay()).card
    assert next(iter(card.items())) == ("description", "A tank that drains.")
    assert "description" not in Simulate(episodes=2, steps=5).run(decay()).card


def test_a_world_is_simulated_and_its_gap_stands_out_of_the_noise() -> None:
    std = {"phi": 0.01, "omega": 0.05}
    truth = {"m": 1, "l": 1, "C_m": 1, "friction_loss": 0.2, "damping": 0.1, "drag": 0.5}
    columns, card = Simulate(episodes=6, steps=40, noise_std=std, truth=truth).run(world_of("pendulum_world.yaml"))
    assert card["truth"] == truth
    node = yaml.safe_load((CONF / "pendulum.yaml").read_text())
    gravity_only = RK4(Declared(**node).model())
    states = np.column_stack([columns["phi"], columns["omega"]])
    predicted = gravity_only.step(states, columns["u"][:, None], np.tile([1.0, 1.0, 1.0], (240, 1)))
    last = np.arange(240) % 40 == 39
    omega = states[:, 1][~last]
    residual = (states[1:, 1] - predicted[:-1, 1])[~last[:-1]]
    slope, error = _slope(omega, residual)
    assert slope < -10 * error  # it brakes, in both directions
    assert -0.05 < slope < -0.005  # 1/s times 0.05 s: damping, drag and friction together


def _slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    slope = (x @ y) / (x @ x)
    return slope, np.std(y - slope * x) / np.sqrt(x @ x)


@pytest.mark.parametrize("law", [HeldRandom(), HeldRandom(0.3, 0.3), Multisine(), Zero()])
def test_excitations_stay_in_range_and_have_their_length(law: Excitation) -> None:
    signal = law.signal(np.random.default_rng(0), 777, 0.05, U)
    assert signal.shape == (777,)
    assert signal.min() >= U.low
    assert signal.max() <= U.high


def test_held_values_last_as_long_as_declared_and_fill_the_range() -> None:
    signal = HeldRandom(0.1, 0.4).signal(np.random.default_rng(0), 5000, 0.05, U)
    changes = np.flatnonzero(np.diff(signal)) + 1
    holds = np.diff(changes)
    assert (holds.min(), holds.max()) == (2, 8)
    assert kstest(signal[changes], "uniform", (-1, 4)).pvalue > 1e-3


def test_a_multisine_has_its_frequencies_only_and_touches_the_range() -> None:
    dt, n = 0.05, 2000  # 100 s: 1 and 3 Hz fall on bins
    signal = Multisine(1.0, 3.0, 2).signal(np.random.default_rng(0), n, dt, U)
    assert np.isclose(np.abs(signal - 1).max(), 2)
    power = np.abs(np.fft.rfft(signal - 1)) ** 2
    power /= power.sum()
    np.testing.assert_allclose(power[[100, 300]], 0.5, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "fragment"),
    [
        (lambda: HeldRandom(0.5, 0.1), r"give 0 < shortest <= longest"),
        (lambda: Multisine(2, 1), r"give 0 < lowest < highest"),
        (lambda: Multisine(count=1), r"excitation\.count: 1 sines"),
        (lambda: Multisine(highest=10).signal(np.random.default_rng(0), 9, 0.05, U), r"1/\(2 dt\) = 10 Hz"),
        (lambda: Simulate(episodes=0), r"simulation\.episodes: 0 is not allowed; give at least 1"),
        (lambda: Simulate(test_fraction=1), r"simulation\.test_fraction: 1 is not allowed"),
        (lambda: Simulate(noise_std={"c": -1}), r"simulation\.noise_std\.c: -1 is no standard deviation"),
        (
            lambda: Simulate(noise_std={"cc": 1}).run(decay()),
            r"noise_std\.cc: .*known: c, q\. Did you mean c",
        ),
        (
            lambda: Simulate(unmeasured=("cc",)).run(decay()),
            r"simulation\.unmeasured\.cc: no such name; known: c, q\. Did you mean c",
        ),
        (
            lambda: Simulate(unmeasured=("q", "c")).run(decay()),
            r"simulation\.unmeasured: nothing of decay is left to measure",
        ),
        (lambda: Simulate(truth={"K": 1}).run(decay()), r"simulation\.truth\.K: no such name; known: k, b"),
        (lambda: Simulate(initial={"u": [0, 1]}).run(decay()), r"simulation\.initial\.u: no such name; known: c"),
        (lambda: Simulate(initial={"c": [1, 0]}).run(decay()), r"simulation\.initial\.c: \[1, 0\] is no range"),
        (lambda: Simulate(episodes=1).run(decay()), r"one episode cannot be split .* simulation\.episodes: 2"),
        (
            lambda: Simulate(episodes=2).run(decay(dynamics={"c": "c**3"})),
            r"simulation: c of decay is \S+ at t = \d.* s of episode 0; narrow simulation\.initial",
        ),
        (
            lambda: Simulate().run(decay(states={"t": {"range": [0, 1]}}, dynamics={"t": "-t"}, outputs={"q": "2*t"})),
            r"decay calls a quantity `t`",
        ),
    ],
)
def test_errors_name_the_key_and_the_cure(make: Any, fragment: str) -> None:
    with pytest.raises(ModelError, match=fragment):
        make()


def test_transitions_are_rows_of_their_own() -> None:
    """c(dt) of c' = -k c + b u in closed form; noise on the next state only; the exact one beside it."""
    truth = {"k": 1.3, "b": 0.4}
    made = Simulate(
        episodes=1,
        steps=4000,
        layout="transitions",
        noise_on="next",
        noise_std={"c": 0.05},
        truth=truth,
        initial={"c": [1, 1.5]},
    ).run(decay())
    columns = made.columns
    assert [*columns] == ["c", "next_c", "exact_next_c", "u", "q", "split"]
    c, u = columns["c"], columns["u"]
    keep = np.exp(-0.13)
    np.testing.assert_allclose(columns["exact_next_c"], c * keep + 0.4 * u / 1.3 * (1 - keep), rtol=1e-9)
    assert kstest((c - 1) / 0.5, "uniform").pvalue > 1e-3
    assert kstest((u + 1) / 4, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(c[1:], columns["exact_next_c"][:-1])[0, 1]) < 0.1  # rows do not follow each other
    assert kstest((columns["next_c"] - columns["exact_next_c"]) / 0.05, "norm").pvalue > 1e-3
    np.testing.assert_allclose(columns["q"], 2 * c + u)
    assert made.card["columns"]["exact_next_c"] == {"unit": "mol"}
    assert (made.card["layout"], made.card["noise_on"]) == ("transitions", "next")
    assert "t" not in made.card["columns"]


def test_noise_on_both_states_is_drawn_apart() -> None:
    both = Simulate(episodes=1, steps=2000, layout="transitions", noise_std={"c": 0.05}).run(decay()).columns
    exact = (
        Simulate(episodes=1, steps=2000, layout="transitions", noise_std={"c": 0.05}, noise_on="next")
        .run(decay())
        .columns
    )
    before, after = both["c"] - exact["c"], both["next_c"] - both["exact_next_c"]
    np.testing.assert_array_equal(both["next_c"], exact["next_c"])
    assert before.std() == pytest.approx(0.05, rel=0.1)
    assert abs(np.corrcoef(before, after)[0, 1]) < 0.1


def test_more_transitions_begin_with_the_fewer_ones() -> None:
    few, many = (
        Simulate(episodes=1, steps=n, layout="transitions", noise_std={"c": 0.05}, test_fraction=0).run(decay()).columns
        for n in (50, 80)
    )
    for name, values in few.items():
        np.testing.assert_array_equal(many[name][:50], values)


def test_unmeasured_states_have_no_column_before_or_after() -> None:
    made = Simulate(episodes=1, steps=20, layout="transitions", unmeasured=("w",), test_fraction=0).run(turntable())
    assert [*made.columns] == ["a", "next_a", "exact_next_a"]
    assert np.abs(made.columns["exact_next_a"]).max() <= np.pi


@pytest.mark.parametrize(("key", "value"), [("layout", "rows"), ("noise_on", "first")])
def test_words_of_the_layout(key: str, value: str) -> None:
    with pytest.raises(ModelError, match=rf"simulation\.{key}: '{value}' is not allowed, only"):
        Simulate(**{key: value})


def test_a_time_of_its_own_needs_rows_without_time() -> None:
    timed = decay(inputs={"t": {"unit": "s", "range": [0, 1]}}, dynamics={"c": "-k*c + b*t"}, outputs={})
    with pytest.raises(ModelError, match=r"a quantity `t`, as a column of its own is called .*layout=transitions"):
        Simulate(episodes=2, steps=3).run(timed)
    assert "t" in Simulate(episodes=1, steps=3, layout="transitions").run(timed).columns


def late_model(low: float, high: float) -> Model:
    """v' = u, with an input that is late by an uncertain d."""
    return Declared(
        "late", dt=0.1, substeps=1, states={"v": {"unit": "m/s", "range": [0, 0.1]}},
        inputs={"u": {"unit": "V", "range": [-1, 1], "delay": "d"}},
        parameters={"d": {"unit": "s", "range": [low, high]}}, dynamics={"v": "u"},
    ).model()  # fmt: skip


def test_trajectories_follow_late_inputs() -> None:
    """v' = u(t - 0.25 s) from rest: position by hand, the first input held before the record."""
    late = late_model(0.25, 0.2500001)
    made = Simulate(episodes=2, steps=30, initial={"v": [0, 0]}, truth={"d": 0.25}).run(late).columns
    u, v = made["u"].reshape(2, 30), made["v"].reshape(2, 30)
    before = np.concatenate([np.repeat(u[:, :1], 3, axis=1), u], axis=1)
    pushed = 0.05 * (before[:, :29] + before[:, 1:30])  # half of a row each: three rows ago, then two
    np.testing.assert_allclose(v[:, 1:], np.cumsum(pushed, axis=1), atol=1e-12)


def test_driver_is_pulled_to_means_that_change() -> None:
    """Stationary variance of the discrete process, s^2/(1 - (1 - a)^2), about a mean that is held."""
    law = OrnsteinUhlenbeck(pull=2.0, noise=0.1, hold=1e6, means={"u": 0.5})
    signal = law.signal(np.random.default_rng(3), 200_000, 0.05, U)
    unit = (signal - 1.0) / 2.0  # halves of the range about its middle
    a = 0.1
    assert unit.std() == pytest.approx(0.1 * np.sqrt(0.05) / np.sqrt(1 - (1 - a) ** 2), rel=0.05)
    assert abs(unit.mean()) <= 0.5
    short = law.signal(np.random.default_rng(3), 100, 0.05, U)
    np.testing.assert_array_equal(short, signal[:100])


def test_driver_changes_its_mind_and_stays_within_the_range() -> None:
    law = OrnsteinUhlenbeck(means={"u": 1.0})
    signal = law.signal(np.random.default_rng(0), 20_000, 1 / 30, U)
    assert signal.min() >= -1
    assert signal.max() <= 3
    means = signal.reshape(-1, 40)[:, 20:].mean(axis=1)  # of the second halves of the holds
    assert means.std() > 0.5
    assert abs(np.corrcoef(means[1:], means[:-1])[0, 1]) < 0.2
    with pytest.raises(ModelError, match=r"excitation\.means\.u: 2 is not allowed; give 0 to 1"):
        OrnsteinUhlenbeck(means={"u": 2.0})
    with pytest.raises(ModelError, match=r"excitation\.pull: 0 is not positive"):
        OrnsteinUhlenbeck(pull=0)


def test_a_delay_beyond_its_range_holds_the_first_input() -> None:
    """A truth that the prior did not foresee: 0.5 s where at most 0.2 s were declared; nothing wraps to newer inputs."""
    late = late_model(0.1, 0.2)
    made = Simulate(episodes=2, steps=30, initial={"v": [0, 0]}, truth={"d": 0.5}).run(late).columns
    u, v = made["u"].reshape(2, 30), made["v"].reshape(2, 30)
    before = np.concatenate([np.repeat(u[:, :1], 5, axis=1), u], axis=1)
    np.testing.assert_allclose(v[:, 1:], np.cumsum(0.1 * before[:, :29], axis=1), atol=1e-12)
    # asked for single transitions with too short a past: the oldest input was held, a negative delay is none
    query = RK4(late).follow(np.zeros((2, 1)), np.array([[[1.0], [2.0]]] * 2), np.array([[0.5], [-0.3]]))
    np.testing.assert_allclose(query[:, 0], [0.1, 0.2])


def test_columns_that_would_be_called_alike() -> None:
    twice = Declared(
        "twice", dt=0.1, states={name: {"unit": "m", "range": [0, 1]} for name in ("x", "next_x")},
        dynamics={"x": "1", "next_x": "2"},
    ).model()  # fmt: skip
    with pytest.raises(
        ModelError, match=r"simulation\.layout: twice calls a quantity `next_x`, as the column of a next state"
    ):
        Simulate(episodes=1, steps=5, layout="transitions").run(twice)
    made = Simulate(episodes=2, steps=5).run(twice)
    assert made.card["columns"]["next_x"] == {"unit": "m"}
    counted = Declared(
        "counted", dt=0.1, states={"episode": {"unit": "1", "range": [0, 1]}}, dynamics={"episode": "1"}
    ).model()
    split = Simulate(episodes=1, steps=8, layout="transitions").run(counted).columns["split"]
    assert (split == "test").sum() == 2


SAME = {
    "trajectories": (
        lambda: (decay(), Simulate(episodes=3, steps=20, seed=3, noise_std={"c": 0.1, "q": 0.2})),
        "cfa1a6e29e26a443",
    ),
    "unmeasured": (
        lambda: (decay(), Simulate(episodes=3, steps=20, seed=3, noise_std={"q": 0.2}, unmeasured=("c",))),
        "fb48fa87f9384347",
    ),
    "transitions": (
        lambda: (decay(), Simulate(episodes=2, steps=20, seed=3, layout="transitions", noise_std={"c": 0.1})),
        "6c38ccfeb4dde5b8",
    ),
    "noise on the next": (
        lambda: (
            decay(),
            Simulate(episodes=2, steps=20, seed=3, layout="transitions", noise_on="next", noise_std={"c": 0.1}),
        ),
        "52b40f8920e330cc",
    ),
    "static": (lambda: (static(), Simulate(episodes=2, steps=20, seed=3, noise_std={"f": 0.1})), "499ce91c44cc8516"),
    "angles": (lambda: (turntable(), Simulate(episodes=2, steps=20, seed=3, noise_std={"a": 0.1})), "dd89f3c7282847fd"),
    "late inputs": (lambda: (late_model(0.1, 0.25), Simulate(episodes=2, steps=20, seed=3)), "a70de5a8543ceb4e"),
}


@pytest.mark.parametrize("case", SAME)
def test_a_seed_gives_the_numbers_that_it_always_gave(case: str) -> None:
    """Bit for bit those of version 0.1.0 before it had nuisances; sums and products only, so that no library's sine matters."""
    make, expected = SAME[case]
    source, how = make()
    found = hashlib.sha256()
    for name, values in how.run(source).columns.items():
        found.update(name.encode() + np.ascontiguousarray(values).tobytes())
    assert found.hexdigest()[:16] == expected


@pytest.mark.parametrize(
    "off", [{"latency": {"c": 0}}, {"drift": {"k": 0.0}}, {"between_rows": {"u": "held"}}, {"jitter": 0.0}]
)
def test_what_is_planted_as_nothing_changes_nothing(off: dict[str, Any]) -> None:
    bare, same = (Simulate(episodes=2, steps=9, **how).run(decay()).columns for how in ({}, off))
    for name, values in bare.items():
        np.testing.assert_array_equal(same[name], values)
