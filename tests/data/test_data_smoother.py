"""Speeds that were not measured: found from the simulator's structure, closer to the truth than finite differences."""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from simpel_cli.data import Measurements, read
from simpel_cli.data.estimation.smoother import choose_smoothing, estimate_speeds, slope_noise, speeds
from simpel_cli.data.recording import Episode
from simpel_cli.errors import DataError
from simulators.model import Declared, Model
from simulators.worlds.callable_world import CallableWorld


def declared(states: str, dynamics: dict[str, str]) -> Model:
    ranges = {name: {"range": [0.1, 3], "periodic": name == "phi"} for name in states.split()}
    inputs, parameters = {"u": {"range": [-1, 1]}}, {"k": {"range": [1, 2]}}
    return Declared("m", 0.02, states=ranges, inputs=inputs, parameters=parameters, dynamics=dynamics).model()


PENDULUM = declared("phi omega", {"phi": "omega", "omega": "-30*k*sin(phi) + u"})


def swing(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A decaying swing and its speed; the smoother knows no dynamics, so that any smooth motion will do."""
    return 1.2 * np.sin(6 * t) * np.exp(-0.1 * t), 1.2 * np.exp(-0.1 * t) * (6 * np.cos(6 * t) - 0.1 * np.sin(6 * t))


@pytest.mark.parametrize(
    ("dynamics", "expected"),
    [
        ({"x": "v", "v": "-x"}, {"v": ["x"]}),
        ({"x": "2*v", "v": "-x"}, {}),
        ({"x": "-v", "v": "-x"}, {}),
        ({"x": "v + 0.1", "v": "-x"}, {}),
        ({"x": "v*abs(v)", "v": "-x"}, {}),
        ({"x": "v + u", "v": "-x"}, {}),
        ({"x": "k*v", "v": "-x"}, {}),
        ({"x": "v + 0.001*x", "v": "-x"}, {}),
        ({"x": "v", "v": "x"}, {"v": ["x"], "x": ["v"]}),
    ],
)
def test_speeds_are_found_from_the_structure(dynamics: dict[str, str], expected: dict[str, list[str]]) -> None:
    assert speeds(declared("x v", dynamics)) == expected


@pytest.mark.parametrize(("dt", "gain"), [(0.02, 1.1), (0.005, 5.0), (0.001, 40.0)])
def test_beats_finite_differences_at_every_rate(dt: float, gain: float) -> None:
    t = dt * np.arange(round(4 / dt))
    phi, omega = swing(t)
    noisy = phi + np.random.default_rng(0).normal(0, 1e-3, len(t))
    states = np.stack([noisy, np.full_like(t, np.nan)], axis=1)
    episode = Episode("0", t, states, np.zeros((len(t), 1)), np.empty((len(t), 0)))
    smoothed = estimate_speeds(PENDULUM, (episode,), ("omega",), dt)

    def error(speed: np.ndarray) -> float:
        return float(np.sqrt(np.mean((speed - omega) ** 2)))

    ours = error(smoothed.episodes[0].states[:, 1])
    splines = [make_smoothing_spline(t / dt, noisy, lam=lam).derivative() for lam in 10.0 ** np.arange(-3, 8, 0.5)]
    assert gain * ours < error(np.gradient(noisy, dt))
    assert ours < 1.1 * min(error(spline(t / dt) / dt) for spline in splines)
    position, factor = smoothed.noise["omega"]
    assert position == "phi"
    assert 0.3 * ours < 1e-3 * factor < 2 * ours  # the rest is the bias that smoothing trades for it
    assert "omega = d(phi)/dt of a smoothing spline" in smoothed.check.detail


def test_a_world_shows_no_equations(tmp_path: Path) -> None:
    """MuJoCo and functions of the user's answer queries only: nothing is estimated, and nothing compared."""
    world = CallableWorld(
        "w",
        0.02,
        lambda s, u, p: s,
        True,
        states={n: {"range": [-9, 9]} for n in ("x", "v")},
        inputs={"u": {"range": [-1, 1]}},
    ).model()
    assert speeds(world) == {}
    rows = [f"{0.02 * i:.2f},{np.sin(i / 9):.6f},{99 * np.cos(i / 9):.6f},0.{i}" for i in range(60)]
    (tmp_path / "d.csv").write_text("\n".join(["t,x,v,u", *rows]))
    recording = read(Measurements("d.csv", time="t", split={"by": "time"}), world, tmp_path, 0)
    assert {c.name: c.ok for c in recording.checks}["kinematics"]
    with pytest.raises(DataError, match=r"data\.columns\.v: null.*None of its states can be estimated"):
        read(Measurements("d.csv", time="t", columns={"v": None}, split={"by": "time"}), world, tmp_path, 0)


def test_smoothing_is_that_of_generalised_cross_validation() -> None:
    """Against the exact trace of the hat matrix, made column by column."""
    n = 80
    x = np.arange(n, dtype=float)
    signal = np.sin(x / 8) + np.random.default_rng(3).normal(0, 0.1, n)

    def exact(lam: float) -> float:
        hat = np.stack([make_smoothing_spline(x, unit, lam=lam)(x) for unit in np.eye(n)], axis=1)
        return float(np.mean((signal - hat @ signal) ** 2) / (1 - np.trace(hat) / n) ** 2)

    grid = 10.0 ** np.arange(-1, 5.1, 0.5)
    assert choose_smoothing([signal]) == pytest.approx(min(grid, key=exact))


def test_slope_noise_is_that_of_a_smoothed_white_series() -> None:
    noise = np.random.default_rng(0).normal(size=20_000)
    x = np.arange(20_000, dtype=float)
    slope = make_smoothing_spline(x, noise, lam=50.0).derivative()(x)
    assert np.std(slope) == pytest.approx(slope_noise(50.0), rel=0.05)


def test_read_estimates_a_wrapped_angle(tmp_path: Path) -> None:
    t = 0.02 * np.arange(300)
    angle = 5 * t + 0.5 * np.sin(3 * t)
    wrapped = (angle + np.random.default_rng(0).normal(0, 1e-3, 300) + np.pi) % (2 * np.pi) - np.pi
    text = "t,phi,u\n" + "".join(f"{a:.4f},{b:.9f},0.1\n" for a, b in zip(t, wrapped, strict=True))
    (tmp_path / "d.csv").write_text(text)
    config = Measurements("d.csv", time="t", columns={"omega": None}, split={"by": "time"})
    recording = read(config, PENDULUM, tmp_path, 0)
    assert recording.estimated == ("omega",)
    train = recording.train[0]
    error = train.states[:, 1] - (5 + 1.5 * np.cos(3 * train.time))
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert recording.noise_std["omega"] > 0


def test_a_state_that_is_no_speed_cannot_be_estimated(tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("t,omega,u\n" + "".join(f"{0.02 * i:.2f},{i},0.{i}\n" for i in range(20)))
    config = Measurements("d.csv", time="t", columns={"phi": None}, split={"by": "time"})
    with pytest.raises(DataError, match=r"data\.columns\.phi: null.*None of its states can be estimated") as error:
        read(config, PENDULUM, tmp_path, 0)
    assert error.value.exit_code == 3
    chain = declared("x v z", {"x": "v", "v": "-x", "z": "-z"})
    episode = Episode("0", np.arange(9.0), np.ones((9, 3)), np.zeros((9, 1)), np.empty((9, 0)))
    with pytest.raises(DataError, match=r"data.columns.z: null.*can be estimated: v from x\."):
        estimate_speeds(chain, (episode,), ("z",), 1.0)
