"""Planted parameters that differ between groups of episodes, with a known covariate, and within an episode."""

from typing import Any

import numpy as np
import pytest
import yaml
from test_simulate import decay, static, world_of

from simulators.model import ModelError
from simulators.worlds.excitation import Zero
from simulators.worlds.groups import Covariate, Group, Spread
from simulators.worlds.simulate import Simulate, Simulation


def rates(made: Simulation, n: int, steps: int) -> np.ndarray:
    """Return k of every episode of the free decay, from its data."""
    c = made.columns["c"].reshape(n, steps)
    return np.log(c[:, 0] / c[:, 1]) / 0.1


def test_episodes_are_dealt_to_groups_in_turn_and_members_share_their_parameter() -> None:
    how = Simulate(
        episodes=7, steps=4, excitation=Zero(), truth={"k": 1.2, "b": 0.0}, test_fraction=0,
        groups={"ball": Group(3, {"k": Spread(0.2, "lognormal")})},
    )  # fmt: skip
    made = how.run(decay())
    ball = made.columns["ball"]
    assert [*ball[::4]] == ["ball_0", "ball_1", "ball_2"] * 2 + ["ball_0"]
    assert [*made.columns][:3] == ["episode", "t", "ball"]
    truth = made.card["truth_by_group"]["ball"]
    np.testing.assert_allclose(rates(made, 7, 4), [truth[name]["k"] for name in ball[::4]], rtol=1e-7)
    assert len({each["k"] for each in truth.values()}) == 3
    assert made.card["truth"]["k"] == 1.2
    assert made.card["groups"] == {"ball": {"count": 3, "parameters": {"k": {"law": "lognormal", "std": 0.2}}}}
    assert yaml.safe_load(yaml.safe_dump(made.card)) == made.card


@pytest.mark.parametrize(("law", "undo"), [("normal", lambda k: k - 1.2), ("lognormal", lambda k: np.log(k / 1.2))])
def test_many_groups_have_the_spread(law: str, undo: Any) -> None:
    n = 1000
    how = Simulate(
        episodes=n, steps=2, excitation=Zero(), truth={"k": 1.2, "b": 0.0}, test_fraction=0,
        groups={"ball": Group(n, {"k": Spread(0.1, law)})},
    )  # fmt: skip
    away = undo(rates(how.run(decay()), n, 2))
    assert abs(away.mean()) < 4 * 0.1 / np.sqrt(n)
    assert away.std() == pytest.approx(0.1, rel=4 / np.sqrt(2 * n))


def test_groups_leave_everything_else_as_it_was_and_more_of_them_the_first() -> None:
    plain = Simulate(episodes=4, steps=9).run(decay())
    few, many = (
        Simulate(episodes=4, steps=9, groups={"ball": Group(n, {"k": Spread(0.1)})}).run(decay()) for n in (2, 3)
    )
    np.testing.assert_array_equal(few.columns["u"], plain.columns["u"])
    assert few.card["truth"] == plain.card["truth"]
    first, again = (each.card["truth_by_group"]["ball"] for each in (few, many))
    assert first == {name: again[name] for name in first}


def test_two_groupings_come_in_all_combinations() -> None:
    made = Simulate(
        episodes=12, steps=1, groups={"ball": Group(3, {"k": Spread(0.1)}), "floor": Group(2, {"b": Spread(0.1)})}
    ).run(decay())
    pairs = list(zip(made.columns["ball"], made.columns["floor"], strict=True))
    assert len(set(pairs)) == 6
    assert pairs[:6] == pairs[6:]


def test_a_covariate_is_the_parameter_and_a_column_with_its_unit() -> None:
    known = {"rate": Covariate("k", (0.5, 1.5))}
    made = Simulate(episodes=50, steps=3, excitation=Zero(), truth={"b": 0.0}, covariates=known).run(decay())
    rate = made.columns["rate"].reshape(50, 3)
    np.testing.assert_array_equal(rate[:, 0], rate[:, 2])
    np.testing.assert_allclose(rates(made, 50, 3), rate[:, 0], rtol=1e-6)
    assert 0.5 <= rate.min() < 0.6
    assert 1.4 < rate.max() <= 1.5
    assert made.card["columns"]["rate"] == {"unit": "1/s"}
    assert made.card["covariates"] == {"rate": {"parameter": "k", "range": [0.5, 1.5]}}
    assert made.card["truth"] == {"b": 0.0}  # k has no common value


def test_a_covariate_per_group() -> None:
    made = Simulate(
        episodes=6, steps=2, groups={"ball": Group(2, {"b": Spread(0.1)})},
        covariates={"rate": Covariate("k", (0.5, 1.5), per="ball")},
    ).run(decay())  # fmt: skip
    rate = made.columns["rate"][::2]
    assert len(set(rate)) == 2
    np.testing.assert_array_equal(rate[:2], rate[2:4])


def test_what_is_hidden_stays_hidden() -> None:
    card = Simulate(
        episodes=4, steps=5, hide_truth=True, drift={"k": 0.1}, groups={"ball": Group(2, {"k": Spread(0.1)})}
    ).run(decay()).card  # fmt: skip
    assert not card.keys() & {"truth", "truth_by_group", "drift"}
    assert card["groups"] == {"ball": {"count": 2}}


def test_rows_without_episodes_and_worlds_have_groups_too() -> None:
    how: dict[str, Any] = {"groups": {"ball": Group(3, {"k": Spread(0.5, "lognormal")})}, "truth": {"b": 0.0}}
    made = Simulate(episodes=1, steps=30, layout="transitions", **how).run(decay())
    truth = made.card["truth_by_group"]["ball"]
    found = np.log(made.columns["c"] / made.columns["exact_next_c"]) / 0.1
    np.testing.assert_allclose(found, [truth[name]["k"] for name in made.columns["ball"]], rtol=1e-6)
    lines = Simulate(episodes=1, steps=30, covariates={"slope": Covariate("a", (1, 2))}).run(static()).columns
    np.testing.assert_allclose(lines["f"], lines["slope"] * lines["x"] + 1)
    world = world_of("pendulum_world.yaml")
    made = Simulate(
        episodes=4, steps=5, initial={"phi": [1, 1], "omega": [0, 0]}, excitation=Zero(),
        groups={"rig": Group(2, {"l": Spread(0.3, "lognormal")})},
    ).run(world)  # fmt: skip
    phi = made.columns["phi"].reshape(4, 5)
    np.testing.assert_array_equal(phi[:2], phi[2:])
    assert abs(phi[0, -1] - phi[1, -1]) > 1e-3


def test_a_drift_is_linear_in_time_over_the_episode() -> None:
    """c(t) = c(0) exp(-k (t + r t^2/(2 T))), T the time of the last row."""
    how = Simulate(episodes=2, steps=51, excitation=Zero(), truth={"k": 1.3, "b": 0.0}, drift={"k": 0.4})
    made = how.run(decay())
    c, t = made.columns["c"].reshape(2, 51), made.columns["t"][:51]
    np.testing.assert_allclose(c, c[:, :1] * np.exp(-1.3 * (t + 0.4 * t**2 / 10.0)), rtol=1e-6)
    assert made.card["drift"] == {"k": 0.4}
    output = Simulate(episodes=2, steps=51, drift={"g": 0.5}, truth={"g": 2.0, "k": 1.0}).run(
        decay(
            parameters={"k": {"range": [0.5, 2]}, "g": {"range": [1, 3]}}, dynamics={"c": "-k*c + u"}, outputs={"q": "g*c"}
        )
    ).columns  # fmt: skip
    np.testing.assert_allclose(output["q"], 2 * (1 + 0.5 * output["t"] / 5.0) * output["c"], rtol=1e-12)


@pytest.mark.parametrize(
    ("how", "fragment"),
    [
        ({"groups": {"ball": Group(5)}}, r"simulation\.groups\.ball\.count: 5 groups of 4 episodes; give 1 to 4"),
        ({"groups": {"ball": Group(0)}}, r"simulation\.groups\.ball\.count: 0 groups"),
        ({"groups": {"u": Group(2)}}, r"simulation\.groups\.u: there is a column `u` already; choose another name"),
        ({"groups": {"t": Group(2)}}, r"simulation\.groups\.t: there is a column `t` already"),
        ({"groups": {"a b": Group(2)}}, r"simulation\.groups\.a b: 'a b' is no name"),
        ({"groups": {"ball": Group(2, {"kk": Spread(0.1)})}}, r"parameters\.kk: 'kk' is no .*known: k, b\. Did you mean k\?"),
        ({"groups": {"ball": Group(2, {"k": Spread(0.1, "log")})}}, r"groups\.ball\.parameters\.k\.law: 'log' is not allowed"),
        ({"groups": {"ball": Group(2, {"k": Spread(-1)})}}, r"groups\.ball\.parameters\.k\.std: -1 is no standard deviation"),
        (
            {"groups": {"ball": Group(2, {"k": Spread(1)}), "day": Group(2, {"k": Spread(1)})}},
            r"groups\.day\.parameters\.k: k has its value from simulation\.groups\.ball\.parameters\.k already",
        ),
        ({"covariates": {"rate": Covariate("m", (0, 1))}}, r"simulation\.covariates\.rate\.parameter: 'm' is no uncertain"),
        ({"covariates": {"rate": Covariate("k", (1, 0))}}, r"simulation\.covariates\.rate\.range: \[1, 0\] is no range"),
        ({"covariates": {"c": Covariate("k", (0, 1))}}, r"simulation\.covariates\.c: there is a column `c` already"),
        ({"covariates": {"rate": Covariate("k", (0, 1))}, "truth": {"k": 1}}, r"value from simulation\.truth already"),
        (
            {"covariates": {"rate": Covariate("k", (0, 1), "bal")}, "groups": {"ball": Group(2)}},
            r"simulation\.covariates\.rate\.per: 'bal' is no group; known: ball\. Did you mean ball\?",
        ),
        ({"drift": {"kk": 0.1}}, r"simulation\.drift\.kk: no such name; known: k, b\. Did you mean k\?"),
        ({"drift": {"k": float("inf")}}, r"simulation\.drift\.k: inf is not finite"),
    ],
)  # fmt: skip
def test_errors_name_the_key_and_the_cure(how: dict[str, Any], fragment: str) -> None:
    with pytest.raises(ModelError, match=fragment):
        Simulate(episodes=4, steps=5, **how).run(decay())
