"""Measurement noise with heavy tails: noticed, said with its degrees of freedom, and parameters are the better for it."""

import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.search.calibration import Calibrated, calibrated, with_heavy_tails
from simpel_cli.discovery.search.heavy_tails import sentence_of
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.measurements.cleaning import Cleaned
from simpel_cli.filtering.setup import Setup, setup
from simpel_cli.runs.console import Terminal
from simulators.model import Declared, Model

DT, ROWS, NOISE, A, B = 0.1, 120, 0.02, 0.7, 1.3


def model() -> Model:
    return Declared(
        "heavy", dt=DT,
        states={"s": {"unit": "m", "range": [-3, 3]}, "v": {"unit": "m/s", "range": [-3, 3]}},
        inputs={"u": {"unit": "V", "range": [-3, 3], "between_rows": "held"}},
        parameters={"a": {"unit": "1/s", "range": [0.2, 1.2]}, "b": {"unit": "m/s^2/V", "range": [0.8, 1.8]}},
        dynamics={"s": "v", "v": "b*u - a*v"},
    ).model()  # fmt: skip


def recording(seed: int, nu: float | None, load: float = 0.0) -> Recording:
    """Five episodes of dv/dt = B u - A v - load sign(v), in steps of a hundredth of a row; t noise on v."""
    random = np.random.default_rng(seed)
    episodes = []
    for k in range(5):
        u = np.repeat(random.normal(size=ROWS // 5), 5)
        x, states = np.array([0.0, random.normal()]), []
        for now in u:
            states.append(x)
            for _ in range(100):
                x = x + DT / 100 * np.array([x[1], B * now - A * x[1] - load * np.sign(x[1])])
        e = random.normal(size=(ROWS, 2))
        if nu is not None:
            e[:, 1] = random.standard_t(nu, ROWS)
        episodes.append(
            Episode(f"{k}", np.arange(ROWS) * DT, np.array(states) + NOISE * e, u[:, None], np.zeros((ROWS, 0)))
        )
    return Recording(tuple(episodes[:4]), tuple(episodes[4:]), (), {"s": NOISE, "v": NOISE}, (), (), ())


def fitted(data: Recording, *, weighed: bool = True) -> tuple[Setup, Calibrated]:
    plan = setup(model(), data, (), [], 2)
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=6)
    assessor, terminal = Assessor(plan, 5), Terminal(True)
    found = calibrated(plan, fitter, assessor, Cleaned(data, (), {}), terminal)
    heavy = with_heavy_tails(found, assessor, found.base.optimum.z, terminal) if weighed else None
    return plan, heavy or found


def errors(plan: Setup, found: Calibrated) -> tuple[np.ndarray, np.ndarray]:
    """Return error and standard deviation of a and b."""
    optimum = found.base.optimum
    span = (plan.coordinates.high - plan.coordinates.low)[:2]
    values = np.array([plan.coordinates.value(i, float(optimum.z[i])) for i in (0, 1)])
    sd = span * np.sqrt([optimum.covariance[optimum.free.index(i), optimum.free.index(i)] for i in (0, 1)])
    return values - [A, B], sd


def test_student_t_is_noticed_and_no_row_is_lost() -> None:
    _, found = fitted(recording(0, 3.0))
    assert list(found.degrees_of_freedom) == ["v"]
    assert 2 < found.degrees_of_freedom["v"] < 7
    assert "noise of v (Student's t with" in sentence_of(found.degrees_of_freedom)
    assert sentence_of({}) == ""
    weight = found.search.plan.windows.ok
    assert np.mean(weight > 0) > 0.99
    assert np.std(weight[..., 1][weight[..., 1] > 0]) > 0.1
    assert set(np.unique(weight[..., 0])) <= {0.0, 1.0}


@pytest.mark.parametrize("load", [0.0, 0.3])
def test_gaussian_noise_stays_gaussian(load: float) -> None:
    """Also beside a friction that the simulator lacks: what is wrong is no tail."""
    for seed in range(3):
        _, found = fitted(recording(seed, None, load))
        assert found.degrees_of_freedom == {}
        assert set(np.unique(found.search.plan.windows.ok)) <= {0.0, 1.0}


@pytest.mark.slow
def test_parameters_are_better_and_their_intervals_hold() -> None:
    """Twenty records with 3 degrees of freedom: errors against those of the same fit with Gaussian noise, and coverage."""
    ours, plain, inside = [], [], []
    for seed in range(20):
        data = recording(100 + seed, 3.0)
        error, sd = errors(*fitted(data))
        ours.append(error)
        inside.append(np.abs(error) < 1.96 * sd)
        plain.append(errors(*fitted(data, weighed=False))[0])
    ratio = np.sqrt(np.mean(np.square(ours), axis=0) / np.mean(np.square(plain), axis=0))
    print("rmse with t over rmse with Gaussian noise", ratio, "coverage of 95 %", np.mean(inside, axis=0))
    assert (ratio < 1.05).all()
    assert np.mean(inside) > 0.85
