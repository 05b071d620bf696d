"""What data leave open of a simulator's parameters: the input that determines it, or that none does."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_ranges import searched

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.next_experiment import design, determining
from simpel_cli.discovery.next_experiment.design import HOPELESS
from simpel_cli.discovery.next_experiment.determining import determining_experiments, ends_of
from simpel_cli.discovery.search.trials import TIE, Search, Trial
from simpel_cli.discovery.verdict.determined import left_open
from simpel_cli.reporting.discover_sections import determining_section
from simulators.model import Declared, Model

DT, ROWS, DECAY, GAIN = 0.1, 40, 0.5, 1.2


def cart(dynamics: str, **parameters: dict[str, object]) -> Model:
    return Declared(
        "cart", dt=DT,
        states={"s": {"unit": "m", "range": [-30, 30]}, "v": {"unit": "m/s", "range": [-9, 9]}},
        inputs={"u": {"unit": "V", "range": [-3, 3], "between_rows": "held"}},
        parameters=parameters, dynamics={"s": "v", "v": dynamics},
    ).model()  # fmt: skip


def carts(push: float) -> Recording:
    """Carts that slow down by themselves, exactly integrated; `push`: size of the inputs."""
    random, episodes = np.random.default_rng(3), []
    for e in range(4):
        u = push * np.repeat(random.uniform(-1, 1, ROWS // 5), 5)
        x = np.zeros((ROWS, 2))
        x[0] = 0.0, random.uniform(2, 4)
        for i in range(ROWS - 1):
            (s, v), end = x[i], GAIN * u[i] / DECAY
            kept = np.exp(-DECAY * DT)
            x[i + 1] = s + end * DT + (v - end) * (1 - kept) / DECAY, end + (v - end) * kept
        noisy = x + 1e-2 * random.normal(size=x.shape)
        episodes.append(Episode(str(e), np.arange(ROWS) * DT, noisy, u[:, None], np.zeros((ROWS, 0))))
    noise = {"s": 1e-2, "v": 1e-2}
    return Recording(tuple(episodes[:3]), tuple(episodes[3:]), (), noise, (), (Check("c", True, ""),), ())


def calibrated(model: Model, push: float) -> tuple[Search, Trial]:
    search = searched(carts(push), (), model)
    return search, search.base()


def test_what_no_input_has_shown_is_determined_by_one(tmp_path: Path) -> None:
    model = cart("b*u - c*v", b={"unit": "m/s^2/V", "range": [0.5, 2]}, c={"unit": "1/s", "range": [0.2, 1]})
    search, base = calibrated(model, 0.0)
    (one,) = left_open(search, base)
    assert one.words == "b"
    ends = ends_of(search, base, one)
    assert ends is not None
    assert all(t.optimum.loss < base.optimum.loss + TIE for t in ends.trials)  # the data tell nothing of them
    (found,) = determining_experiments(search, base, [one], tmp_path)
    assert found["combination"] == "b"
    assert found["expected_log_likelihood_ratio"] > 50
    assert found["description"].startswith("Run the 4 s")
    table = pd.read_csv(tmp_path / "determining_experiment.csv", comment="#")
    assert np.abs(table["u"]).max() > 1
    first, second = (table[name] for name in table.columns if name.startswith("v_if_b="))
    assert np.abs(first - second).max() > 0.5
    section = determining_section({"determining_experiments": [found]})
    assert section["rows"] == [("b", found["description"], "determining_experiment.csv")]
    assert determining_section({}) == {}


def test_what_the_equations_leave_open_no_input_determines(tmp_path: Path) -> None:
    ranges = {"k": {"unit": "N/V", "range": [0.5, 3]}, "m": {"unit": "kg", "range": [0.5, 2.5]}}
    search, base = calibrated(cart("k*u/m - c*v", **ranges, c={"unit": "1/s", "range": [0.2, 1]}), 3.0)
    (one,) = left_open(search, base)
    assert one.words.endswith("is determined")
    (found,) = determining_experiments(search, base, [one], tmp_path)
    assert found["expected_log_likelihood_ratio"] < HOPELESS
    assert found["description"].startswith("No admissible input determines")
    assert found["file"] is None
    assert list(tmp_path.iterdir()) == []
    ends = ends_of(search, base, one)
    assert ends is not None
    rows = {q.name: i for i, q in enumerate(search.plan.augmented.params)}
    values = [
        [search.plan.coordinates.value(rows[n], float(t.optimum.z[rows[n]])) for n in ("k", "m")] for t in ends.trials
    ]
    assert values[1][0] > 1.2 * values[0][0] or values[1][1] > 1.2 * values[0][1]
    for k, m in values:
        assert k / m == pytest.approx(GAIN, rel=0.02)


def test_where_no_episode_is_admissible_nothing_is_said_of_inputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = cart("b*u - c*v", b={"unit": "m/s^2/V", "range": [0.5, 2]}, c={"unit": "1/s", "range": [0.2, 1]})
    search, base = calibrated(model, 0.0)
    (one,) = left_open(search, base)
    monkeypatch.setattr(design.Designer, "best", lambda _: None)
    (found,) = determining_experiments(search, base, [one], tmp_path)
    assert found["description"].startswith("No episode was found")
    monkeypatch.setattr(determining, "ends_of", lambda *_: None)
    (found,) = determining_experiments(search, base, [one], tmp_path)
    assert found["description"] == "No two models that differ in b were found to explain these data alike."
    assert found["file"] is None
    assert list(tmp_path.iterdir()) == []


def test_what_is_determined_has_no_ends(tmp_path: Path) -> None:
    model = cart("b*u - c*v", b={"unit": "m/s^2/V", "range": [0.5, 2]}, c={"unit": "1/s", "range": [0.2, 1]})
    search, base = calibrated(model, 3.0)
    assert left_open(search, base) == []
    assert determining_experiments(search, base, [], tmp_path) == []
    assert list(tmp_path.iterdir()) == []
