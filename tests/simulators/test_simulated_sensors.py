"""Planted faults of sensors: heavy tails, noise that depends on the motion, steps, ends, missing cells."""

from typing import Any

import numpy as np
import pytest
import yaml
from scipy import stats
from test_simulate import decay, static, turntable, world_of

from simulators.model import ModelError
from simulators.worlds.sensors import NoiseLaw
from simulators.worlds.simulate import Simulate

LONG: dict[str, Any] = {"episodes": 500, "steps": 40}


def columns(source: Any = None, **how: Any) -> dict[str, np.ndarray]:
    return Simulate(**(LONG | how)).run(source or decay(substeps=1)).columns


def test_student_noise_has_its_law_and_noise_std_is_its_scale() -> None:
    clean, noisy = columns(), columns(noise_std={"c": 0.2, "q": 0.2}, noise={"c": NoiseLaw("student_t", 5.0)})
    t, gaussian = ((noisy[name] - clean[name]) / 0.2 for name in ("c", "q"))
    assert stats.kstest(t, stats.t(5).cdf).pvalue > 1e-3
    assert stats.kstest(t, "norm").pvalue < 1e-9
    assert np.quantile(t, 0.99) == pytest.approx(stats.t(5).ppf(0.99), rel=0.1)
    assert t.std() == pytest.approx(np.sqrt(5 / 3), rel=0.05)  # larger than the scale
    assert stats.kurtosis(t) > 2  # 6/(df - 4) = 6
    assert stats.kstest(gaussian, "norm").pvalue > 1e-3
    np.testing.assert_array_equal(noisy["q"], columns(noise_std={"q": 0.2})["q"])  # its stream is its own


def test_gaussian_as_a_word_changes_nothing() -> None:
    given = columns(noise_std={"c": 0.1}, noise={"c": NoiseLaw()}, steps=20)
    np.testing.assert_array_equal(given["c"], columns(noise_std={"c": 0.1}, steps=20)["c"])


def test_the_scale_may_depend_on_true_values() -> None:
    clean, noisy = columns(), columns(noise_std={"c": "0.01 + 0.05*abs(c)", "q": "0.3*abs(u) + 1e-3"})
    c = (noisy["c"] - clean["c"]) / (0.01 + 0.05 * np.abs(clean["c"]))
    q = (noisy["q"] - clean["q"]) / (0.3 * np.abs(clean["u"]) + 1e-3)
    for noise in (c, q):
        assert stats.kstest(noise, "norm").pvalue > 1e-3
    np.testing.assert_array_equal(columns(noise_std={"c": "0.1"})["c"], columns(noise_std={"c": 0.1})["c"])


def test_steps_and_ends_come_after_the_noise_and_are_exact() -> None:
    noise = {"c": 0.3, "q": 0.5}
    noisy = columns(noise_std=noise)
    coarse = columns(noise_std=noise, quantisation={"c": 0.25}, saturates={"c": (0.1, 1.4), "q": (None, 3.0)})
    np.testing.assert_array_equal(coarse["c"], np.clip(0.25 * np.round(noisy["c"] / 0.25), 0.1, 1.4))
    np.testing.assert_array_equal(coarse["q"], np.minimum(noisy["q"], 3.0))
    assert {coarse["c"].min(), coarse["c"].max()} == {0.1, 1.4}  # the ends as declared, though they are no steps
    assert coarse["q"].min() < 0
    np.testing.assert_array_equal(coarse["u"], noisy["u"])


def test_cells_are_missing_one_by_one() -> None:
    whole, holes = columns(noise_std={"c": 0.1}), columns(noise_std={"c": 0.1}, missing={"c": 0.04, "q": 0.3})
    lost = {name: np.isnan(holes[name]) for name in ("c", "q")}
    for name, share in (("c", 0.04), ("q", 0.3)):
        assert abs(lost[name].mean() - share) < 4 * np.sqrt(share * (1 - share) / 20_000)
        np.testing.assert_array_equal(holes[name][~lost[name]], whole[name][~lost[name]])
    assert abs(np.corrcoef(lost["c"], lost["q"])[0, 1]) < 4 / np.sqrt(20_000)
    assert abs(np.corrcoef(lost["c"][1:], lost["c"][:-1])[0, 1]) < 4 / np.sqrt(20_000)
    assert not np.isnan(holes["u"]).any()


def test_more_episodes_and_longer_ones_leave_the_faults_of_the_first() -> None:
    how: dict[str, Any] = {
        "noise_std": {"c": 0.1},
        "noise": {"c": NoiseLaw("student_t", 3.0)},
        "missing": {"c": 0.2},
        "test_fraction": 0,
    }
    small, longer = columns(**how, episodes=2, steps=30), columns(**how, episodes=3, steps=50)
    np.testing.assert_array_equal(longer["c"].reshape(3, 50)[:2, :30].ravel(), small["c"])


def test_an_angle_is_wrapped_before_its_steps_and_ends() -> None:
    made = columns(turntable(), noise_std={"a": 0.2}, quantisation={"a": 0.5}, saturates={"a": (-2.0, 2.0)})
    assert set(np.unique(made["a"])) == {*np.arange(-2, 2.1, 0.5)}


def test_sensors_of_static_models_transitions_and_worlds() -> None:
    f = columns(
        static(),
        episodes=1,
        steps=500,
        test_fraction=0.25,
        noise_std={"f": "0.1*abs(x)"},
        quantisation={"f": 0.1},
        missing={"f": 0.1},
    )["f"]
    known = f[~np.isnan(f)]
    assert 0 < len(known) < len(f)
    np.testing.assert_allclose(known, 0.1 * np.round(known / 0.1), atol=1e-12)
    how: dict[str, Any] = {
        "layout": "transitions",
        "noise_std": {"c": 0.2},
        "saturates": {"c": (1.2, 1.5)},
        "missing": {"c": 0.1},
    }
    both, later = columns(**how, episodes=2), columns(**how, episodes=2, noise_on="next")
    assert np.nanmax(both["c"]) == np.nanmax(both["next_c"]) == 1.5
    assert np.isnan(both["c"]).any()
    assert np.isnan(both["next_c"]).any()
    assert (np.isnan(both["c"]) != np.isnan(both["next_c"])).any()
    assert both["exact_next_c"].max() > 1.5
    assert not np.isnan(later["c"]).any()  # exact: noise on the next only
    assert later["c"].max() > 1.5
    world = world_of("pendulum_world.yaml")
    made = columns(world, episodes=2, steps=20, quantisation={"omega": 0.5}, missing={"phi": 0.3})
    assert np.isnan(made["phi"]).any()
    np.testing.assert_array_equal(made["omega"] % 0.5, 0)


def test_the_card_says_what_was_planted_on_what_is_measured() -> None:
    how = Simulate(
        episodes=2, steps=5, noise_std={"c": "0.1 + 0.2*abs(u)", "q": 0.1},
        noise={"c": NoiseLaw("student_t", 3), "q": NoiseLaw("student_t", 4)},
        quantisation={"c": 0.1}, saturates={"c": (0.0, None), "q": (0.0, 1.0)}, missing={"c": 0.04},
        unmeasured=("q",), hide_truth=True,
    )  # fmt: skip
    card = how.run(decay()).card
    assert yaml.safe_load(yaml.safe_dump(card)) == card
    assert card["noise_std"] == {"c": "0.1 + 0.2*abs(u)"}
    assert card["noise"] == {"c": {"law": "student_t", "degrees_of_freedom": 3}}
    assert (card["quantisation"], card["saturates"], card["missing"]) == ({"c": 0.1}, {"c": [0.0, None]}, {"c": 0.04})
    bare = Simulate(episodes=2, steps=5).run(decay()).card
    assert not bare.keys() & {"noise", "quantisation", "saturates", "missing"}


@pytest.mark.parametrize(
    ("how", "fragment"),
    [
        ({"noise": {"c": NoiseLaw("student")}}, r"simulation\.noise\.c\.law: 'student' is not allowed.* mean student_t"),
        ({"noise": {"c": NoiseLaw("student_t")}}, r"simulation\.noise\.c\.degrees_of_freedom: None is not allowed"),
        ({"noise": {"c": NoiseLaw("student_t", 0)}}, r"degrees_of_freedom: 0 is not allowed; give a number above 0"),
        ({"noise": {"c": NoiseLaw("gaussian", 3)}}, r"gaussian noise has none; leave it out"),
        ({"noise": {"c": NoiseLaw("student_t", 3)}}, r"a law without a scale; give simulation\.noise_std\.c"),
        ({"noise_std": {"c": "0.1*cc"}}, r"simulation\.noise_std\.c: unknown name 'cc'; known here: .*mean c\?"),
        ({"noise_std": {"c": "0.1*k"}}, r"simulation\.noise_std\.c: unknown name 'k'"),
        ({"noise_std": {"c": "c - 10"}}, r"simulation\.noise_std\.c: c - 10 is -\S+ at c = \S+; a scale is 0 or more"),
        ({"quantisation": {"c": 0}}, r"simulation\.quantisation\.c: 0 is no step; give a number above 0"),
        ({"saturates": {"c": (1.0, 0.0)}}, r"simulation\.saturates\.c: \[1\.0, 0\.0\] is not allowed; write \[low, high\]"),
        ({"saturates": {"c": (1.0,)}}, r"simulation\.saturates\.c: \[1\.0\] is not allowed"),
        ({"missing": {"c": 1.0}}, r"simulation\.missing\.c: 1 is no share; give 0 <= share < 1"),
        ({"missing": {"d": 0.1}}, r"simulation\.missing\.d: no such name; known: c, q"),
        ({"quantisation": {"u": 0.1}}, r"simulation\.quantisation\.u: no such name; known: c, q"),
    ],
)  # fmt: skip
def test_errors_name_the_key_and_the_cure(how: dict[str, Any], fragment: str) -> None:
    with pytest.raises(ModelError, match=fragment):
        Simulate(episodes=2, steps=20, **how).run(decay())
