"""The simulators of the recordings against numbers that somebody else derived, and their experiments from end to end."""

from pathlib import Path

import casadi
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import TINY, rig, simpel
from systems import model

from simpel_cli.dynamics.transition import encoding_of, transition

EXPERIMENTS = ("rc_car", "emps", "cascaded_tanks", "ball_drops", "free_pendulum", "silverbox", "tclab")


def step(name: str, state: list[float], inputs: list[float], **known: float) -> np.ndarray:
    """One transition, back in physical coordinates."""
    source = model(name, **known)
    encoding = encoding_of(source)
    x = encoding.to_x(np.array(state), np.array(inputs))
    return np.asarray(encoding.decode(encoding.advance(x[: encoding.dim_state], transition(source, encoding).step(
        jnp.asarray(x), jnp.zeros(0)))))  # fmt: skip


@pytest.mark.parametrize(
    ("state", "inputs", "after"),
    [  # an independent implementation of the kinematic bicycle with an air drag of 1e-4 kg/m: forwards, in reverse, at rest
        ([0.2, -0.1, 0.3, 1.5, 0.4, 0.2], [0.5, 0.8],
         [0.2494217025, -0.08164689665, 0.3203969674, 1.486473671, 0.6282157647, 0.7814085444]),
        ([0, 0, 0, -1.2, 0, 0], [-0.7, -0.5],
         [-0.04046220749, 0.003034627337, 0.01972507293, -1.228213459, 0.1166023809, 0.8282630999]),
        ([0, 0, 1, 0, 0, 0], [1, 0], [0, 0, 1, 0, 0, 0]),
    ],
)  # fmt: skip
def test_rc_car_is_the_kinematic_bicycle(state: list[float], inputs: list[float], after: list[float]) -> None:
    nominal = {"a_max": 8 / 1.65, "b": 1.5**2 / 1.65, "delta_max": 0.3, "tau": 1 / 90}
    np.testing.assert_allclose(step("rc_car", state, inputs, **nominal), after, rtol=5e-6, atol=1e-12)


def test_emps_settles_at_the_speed_where_friction_takes_the_force() -> None:
    """v(t) = F/F_v + (v0 - F/F_v) exp(-F_v t/M), and the position is its integral."""
    mass, friction, force, v0, dt = 95.1, 203.5, 100.0, -0.05, 0.01
    end, decay = force / friction, np.exp(-friction * dt / mass)
    speed = end + (v0 - end) * decay
    position = 0.1 + end * dt + (v0 - end) * mass / friction * (1 - decay)
    np.testing.assert_allclose(step("emps", [0.1, v0], [force], M=mass, F_v=friction), [position, speed], rtol=1e-9)


def test_tanks_keep_water_and_rest_where_inflow_is_outflow() -> None:
    known = {"k_1": 0.05, "k_2": 0.09, "k_u": 0.08}
    rest = [(0.08 * 3 / 0.05) ** 2, (0.08 * 3 / 0.09) ** 2]
    np.testing.assert_allclose(step("cascaded_tanks", rest, [3.0], **known), rest, rtol=1e-12)
    rate = model("cascaded_tanks", **known).function()(casadi.DM([9, 4]), casadi.DM([2]), casadi.DM(0, 1))[0]
    assert float(casadi.sum1(rate)) == pytest.approx(0.08 * 2 - 0.09 * 2)  # what leaves the upper one reaches the lower


def test_a_ball_falls_along_a_parabola() -> None:
    dt = 1 / 15
    after = step("ball_drops", [40.0, -3.0], [])
    np.testing.assert_allclose(after, [40 - 3 * dt - 9.81 * dt**2 / 2, -3 - 9.81 * dt], rtol=1e-12)


def test_a_heater_relaxes_towards_where_it_gives_off_what_it_gets() -> None:
    """T(t) = T_a + a Q/(U A) + (T_0 - T_a - a Q/(U A)) exp(-U A t/(m c)) of either heater; they do not feel each other."""
    known, start, powers = {"U": 10.0, "a_1": 0.01, "a_2": 0.0075, "T_a": 21.0}, [30.0, 25.0], [80.0, 40.0]
    rate = 10 * 0.001 / (0.004 * 500)
    rest = 21 + np.array([0.01, 0.0075]) * powers / (10 * 0.001)
    np.testing.assert_allclose(
        step("tclab", start, powers, **known), rest + (start - rest) * np.exp(-3 * rate), rtol=1e-9
    )


def test_the_silverbox_swings_as_an_oscillator_does() -> None:
    """exp(A dt) of the companion matrix, about the deflection u/k of the held input."""
    m, d, k, u, dt = 5.09e-6, 2.2e-4, 0.972, 0.05, 1 / 610.3515625
    w, damping = np.sqrt(k / m), d / (2 * np.sqrt(k * m))
    wd, y0, v0 = w * np.sqrt(1 - damping**2), 0.1 - u / k, -20.0
    decay, (c, s) = np.exp(-damping * w * dt), (np.cos(wd * dt), np.sin(wd * dt))
    b = (v0 + damping * w * y0) / wd
    y = decay * (y0 * c + b * s)
    v = decay * (wd * (b * c - y0 * s)) - damping * w * y
    np.testing.assert_allclose(step("silverbox", [0.1, v0], [u], m=m, d=d, k=k), [y + u / k, v], rtol=2e-3)


@pytest.mark.parametrize(
    "experiment", [pytest.param(e, marks=[] if e == "emps" else [pytest.mark.slow]) for e in EXPERIMENTS]
)
def test_experiment_runs_on_its_recording(
    experiment: str, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIMPEL_SHARED", str(shared))
    small = [w for w in TINY if not w.startswith("method.steps")]
    result = simpel(tmp_path, "fit", f"experiment={experiment}", *small, "method.steps=50", "hydra.run.dir=run")
    assert result.code == 0, result.err
    table = pq.read_table(tmp_path / "run" / "metrics.parquet").to_pylist()
    rmse = {row["output"]: row["value"] for row in table if row["metric"] == "rmse" and row["split"] == "test"}
    assert rmse
    assert np.isfinite(list(rmse.values())).all()
    if experiment == "emps":  # two files, found again from the run's own configuration
        again = simpel(tmp_path, "evaluate", "run", "run.quiet=true")
        assert again.code == 0, again.err


@pytest.mark.parametrize(
    "experiment", [pytest.param(e, marks=pytest.mark.slow) for e in ("racecar", "greenhouse", "sergio")]
)
def test_experiment_runs_on_data_that_come_along(experiment: str, tmp_path: Path) -> None:
    small = [w for w in TINY if not w.startswith("method.steps")]
    words = [f"experiment={experiment}", *small, "method.steps=50", "run.figures=false", "hydra.run.dir=run"]
    result = simpel(tmp_path, "fit", *words)
    assert result.code == 0, result.err
    table = pq.read_table(tmp_path / "run" / "metrics.parquet").to_pylist()
    joint = [row["value"] for row in table if (row["metric"], row["output"], row["split"]) == ("nll", "joint", "test")]
    assert len(joint) == 1
    assert np.isfinite(joint).all()


def test_recordings_that_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SIMPEL_SHARED", str(tmp_path / "nowhere"))
    result = simpel(tmp_path, "fit", "experiment=rc_car")
    assert result.code == 2
    assert f"data.path: SIMPEL_SHARED is '{tmp_path / 'nowhere'}', which is no folder" in result.err
    assert "export SIMPEL_SHARED=FOLDER" in result.err


def test_an_experiment_composes_without_its_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SIMPEL_SHARED", str(tmp_path / "nowhere"))
    result = simpel(tmp_path, "fit", "experiment=rc_car", "--cfg", "job")
    assert result.code == 0, result.err
    measured = rig(tmp_path)  # measurements of one's own need no recordings
    result = simpel(
        tmp_path, "fit", "--config-dir", measured, "experiment=emps", "sim=cart", "data=rig", "method.steps=x"
    )
    assert "SIMPEL_SHARED" not in result.err
    assert "method.steps" in result.err
