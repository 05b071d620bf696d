"""Whether a prior can explain the data: right for data of the prior itself, and for data that no parameters explain."""

from functools import cache, partial

import jax
import numpy as np
import pytest

from simpel_cli.inference.assemble import assemble
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.prior_predictive import SURPRISING, PriorCheck, check_prior, measurement_noise
from simpel_cli.inference.protocols import Bank, Normaliser, Setting, Training
from simpel_cli.inference.system import System, normaliser_of, system_of
from simpel_cli.priors.function_prior import GapGP, SimulatorPrior
from simpel_cli.runs.settings import stream
from simpel_cli.scores.gaussian import Gaussian
from simulators.model import Declared

NOISE = 0.02


RAMP = Declared(
    "ramp", dt=1.0, inputs={"x": {"unit": "m", "range": [-1, 1]}},
    parameters={"a": {"range": [0.5, 1.5], "unit": "1"}, "b": {"range": [0, 3], "unit": "1/m"}},
    outputs={"f": {"unit": "m", "expression": "a*tanh(b*x)"}},
)  # fmt: skip


@pytest.fixture(scope="module")
def ramp() -> System:
    """A curve whose height and bend are uncertain, and no normal law."""
    return bound(False)[0]


@cache
def bound(gap: bool) -> tuple[System, Normaliser, Setting, np.ndarray | None]:
    """Simulator, normaliser and prior; kappa as chosen on a curve that the simulator has not."""
    system, x = system_of(RAMP.model(), ("f",), 0), np.linspace(-0.9, 0.9, 15)
    normaliser = normaliser_of(system, stream(0, "normaliser"))
    y = np.tanh(x) + 0.3 * x**2
    assembled = assemble(
        system, normaliser, SimulatorPrior(gap=GapGP() if gap else None), Gaussian(), [Training(x[:, None], y[:, None])],
        {"f": NOISE}, {"f": NOISE}, noise=NoiseModel(), pool=64, keys=[stream(0, "prior")], precision="float32",
    )  # fmt: skip
    return system, normaliser, assembled.setting, np.asarray(assembled.problems.gap_scale[0]) if gap else None


def checked(y: np.ndarray, x: np.ndarray, gap: bool = True, relevance: np.ndarray | None = None) -> PriorCheck:
    system, normaliser, setting, kappa = bound(gap)
    key = stream(0, "prior_predictive")
    found = check_prior(
        system, setting, normaliser, x[:, None], y[:, None], {"f": NOISE}, kappa, key, gap_relevance=relevance
    )
    assert found is not None
    return found


def test_data_of_the_prior_itself_surprise_as_often_as_they_should(ramp: System) -> None:
    random, x = np.random.default_rng(0), np.linspace(-0.9, 0.9, 15)
    shares = []
    for k in range(20):
        y = ramp.simulate(jax.random.key(k), x[:, None], 1)[0, :, 0] + NOISE * random.normal(size=15)
        (found,) = checked(y, x, gap=False).outputs
        shares.append(found.p)
        assert found.outside == 0
        assert found.distance_with_gap is None
    # uniform on 0..1: the mean of 20 has a standard deviation of 0.065
    assert np.mean(shares) == pytest.approx(0.5, abs=0.2)
    assert np.mean(np.array(shares) < 0.2) < 0.4
    assert min(shares) > SURPRISING


def test_values_beyond_every_draw_are_counted(ramp: System) -> None:
    x = np.linspace(-0.9, 0.9, 12)
    y = np.tanh(x)
    y[3] = 2.5
    check = checked(y, x, gap=False)
    (found,) = check.outputs
    assert (found.outside, found.rows) == (1, 12)
    assert not found.by_simulator
    assert not found.explained
    assert found.distance > 3
    assert [bool(o) for o in check.table["outside"]] == [i == 3 for i in range(12)]
    assert check.table["measured"] == y.tolist()
    low, high = np.array(check.table["lowest"]), np.array(check.table["highest"])
    assert (low[:3] <= y[:3]).all()
    assert (y[4:] <= high[4:]).all()
    assert np.all(np.array(check.table["low"]) <= np.array(check.table["median"]))


def test_a_shape_that_no_parameters_have_surprises_though_every_value_is_in_range(ramp: System) -> None:
    x = np.linspace(-0.9, 0.9, 15)
    y = np.tanh(x) + 0.1 * np.sin(12 * x)
    (found,) = checked(y, x).outputs
    assert not found.by_simulator
    assert found.p < SURPRISING
    (alone,) = checked(y, x, gap=False).outputs
    assert not alone.explained


def test_a_gap_explains_what_the_simulator_cannot(ramp: System) -> None:
    x = np.linspace(-0.9, 0.9, 15)
    (found,) = checked(np.tanh(x) + 0.3 * x**2, x).outputs
    assert not found.by_simulator
    assert found.explained
    assert found.distance_with_gap is not None
    assert found.distance_with_gap < 2


def test_a_gap_has_the_lengthscales_that_were_chosen(ramp: System) -> None:
    x = np.linspace(-0.9, 0.9, 15)
    y = np.tanh(x) + 0.3 * np.sin(8 * x)  # as fast as no gap of the declared lengthscale, 2
    declared, same, chosen = (
        checked(y, x, relevance=r).outputs[0] for r in (None, np.full((1, 1), 0.5), np.full((1, 1), 4.0))
    )
    assert declared.distance_with_gap == pytest.approx(same.distance_with_gap)
    assert chosen.distance_with_gap < 0.5 * declared.distance_with_gap
    assert chosen.distance == declared.distance


def test_the_noise_of_the_state_that_a_step_starts_from_counts_as_the_simulator_makes_it() -> None:
    """x' = A x with a speed that decays: a change carries sigma^2 + (A sigma^2 A')_ii."""
    declared = Declared(
        "glider", dt=0.5,
        states={"s": {"unit": "m", "range": [-1, 1]}, "v": {"unit": "m/s", "range": [-5, 5]}},
        inputs={"u": {"unit": "N", "range": [-1, 1]}},
        parameters={"b": {"range": [0.9, 1.1], "unit": "1/s"}},
        dynamics={"s": "v", "v": "u - b*v"},
    ).model()  # fmt: skip
    system = system_of(declared, (), 0)
    x = np.random.default_rng(0).uniform(-1, 1, (6, 3))
    found = measurement_noise(system, x, {"s": 1e-4, "v": 0.05}, jax.random.key(0))
    decay = np.exp(-0.5)
    wanted = [np.hypot(np.hypot(1e-4, 1e-4), (1 - decay) * 0.05), 0.05 * np.hypot(1, decay)]
    np.testing.assert_allclose(found, np.tile(wanted, (6, 1)), rtol=0.03)
    assert measurement_noise(system, x, {}, jax.random.key(0)).max() == 0


def test_of_a_bank_its_first_rows_count_and_few_draws_tell_nothing(ramp: System) -> None:
    x = np.linspace(-0.9, 0.9, 5)
    normaliser = normaliser_of(ramp, stream(0, "normaliser"))
    setting = Setting(
        SimulatorPrior(gap=None).bind(ramp.transition, 1, 1, np.asarray(normaliser.x_std)), Gaussian(), lambda *_: x
    )  # type: ignore[arg-type, return-value]
    drawn = np.moveaxis(ramp.simulate(jax.random.key(3), np.concatenate([x, [0.1] * 20])[:, None], 1000), 0, -1)
    judge = partial(
        check_prior, ramp, setting, normaliser, x[:, None], np.tanh(x)[:, None], {"f": NOISE}, None, jax.random.key(1)
    )
    found = judge(Bank(np.zeros((25, 1)), drawn))
    assert found is not None
    assert found.outputs[0].explained
    np.testing.assert_allclose(found.table["lowest"], drawn[:5, 0].min(axis=-1), rtol=1e-6)
    assert judge(Bank(np.zeros((25, 1)), drawn[:, :, :100])) is None
    lost = judge(Bank(np.zeros((25, 1)), drawn + 1.0))
    assert lost is not None
    assert not lost.outputs[0].explained
