"""States that drive a measured one: recovered from its rate where the simulator tells them apart."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import model

from simpel_cli.data import Measurements, read
from simpel_cli.data.estimation.hidden_states import Drive, drive, solve
from simpel_cli.errors import DataError
from simulators.model import Declared, Model

TANKS = model("cascaded_tanks")


def declared(dynamics: dict[str, str]) -> Model:
    states = {name: {"range": [0.1, 3]} for name in dynamics}
    return Declared("m", 0.1, states=states, inputs={"u": {"range": [-1, 1]}}, dynamics=dynamics).model()


def fill(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Levels (T, 2) and pump (T,) with every parameter in the middle of its range."""
    k_1, k_2, k_u = ((q.low + q.high) / 2 for q in TANKS.params)
    pump = 3 + 2 * np.sin(2 * np.pi * t / 600)

    def rate(now: float, h: np.ndarray) -> list[float]:
        flow = k_1 * np.sqrt(h[0])
        return [k_u * np.interp(now, t, pump) - flow, flow - k_2 * np.sqrt(h[1])]

    return solve_ivp(rate, (0, t[-1]), [15.0, 6.0], t_eval=t, max_step=2, rtol=1e-9).y.T, pump


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_level_of_the_upper_tank_from_the_lower(tmp_path: Path, noise: float) -> None:
    t = 4.0 * np.arange(500)
    levels, pump = fill(t)
    seen = levels[:, 1] + np.random.default_rng(0).normal(0, noise, len(t))
    rows = "".join(f"{a:.0f},{b:.9f},{c:.9f}\n" for a, b, c in zip(t, seen, pump, strict=True))
    (tmp_path / "d.csv").write_text("t,h_2,u\n" + rows)
    recording = read(Measurements("d.csv", time="t", columns={"h_1": None}, split={"by": "time"}), TANKS, tmp_path, 0)
    assert recording.estimated == ("h_1",)
    train = recording.train[0]
    error = train.states[:, 0] - levels[: len(train.time), 0]
    rmse = np.sqrt(np.mean(error[5:-5] ** 2))
    assert rmse < (0.01 if noise == 0 else 0.3)
    if noise:
        assert 0.3 * rmse < recording.noise_std["h_1"] < 3 * rmse
    (check,) = [c for c in recording.checks if c.name == "estimated"]
    assert not check.ok  # it leans on the simulator: something to look at
    assert "h_1 from d(h_2)/dt, by the simulator with its parameters in the middle of their ranges" in check.detail


@pytest.mark.parametrize(
    ("dynamics", "found"),
    [
        ({"p": "2*z - p", "z": "-z"}, Drive(1, 0, True)),
        ({"p": "u - z**3", "z": "-z"}, Drive(1, 0, False)),
        ({"p": "(z - 1)**2", "z": "-z"}, None),  # two values of z have the same rate
        ({"p": "-p", "z": "p - z"}, None),  # p does not see z
        ({"p": "z + w", "z": "-z", "w": "-w"}, None),  # nor can z be told from w
        ({"p": "z*w", "z": "-z", "w": "z"}, None),
    ],
)
def test_which_states_can_be_told(dynamics: dict[str, str], found: Drive | None) -> None:
    source = declared(dynamics)
    assert drive(source, "z", [name for name in dynamics if name != "p"]) == found


def test_rates_that_no_value_explains_end_at_the_range_and_are_counted() -> None:
    source = declared({"p": "u - z", "z": "-z"})
    found = drive(source, "z", ["z"])
    assert found is not None
    states, inputs = np.full((4, 2), np.nan), np.array([[0.5], [0.5], [0.5], [0.5]])
    states[:, 0] = 1.0
    solved = solve(source, found, states, inputs, rate=np.array([0.5 - 1.7, 0.5 - 0.1001, 5.0, -5.0]))
    np.testing.assert_allclose(solved.values, [1.7, 0.1001, 0.1, 3.0], atol=1e-8)
    assert (solved.at_an_end, solved.sensitivity) == (0.5, pytest.approx(1.0))


def test_what_cannot_be_told_is_refused(tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("t,p,u\n" + "".join(f"{0.1 * i:.1f},{i % 7},0.{i}\n" for i in range(20)))
    config = Measurements("d.csv", time="t", columns={"z": None}, split={"by": "time"})
    with pytest.raises(
        DataError, match=r"data\.columns\.z: null, but no measured state has 'z' as .* or a rate that tells it"
    ):
        read(config, declared({"p": "(z - 1)**2 + u", "z": "-z"}), tmp_path, 0)
