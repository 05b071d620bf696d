"""Single-cell expression: numbers of SYSTEMS.md, section 5, through both integrators, and what must be kept."""

from dataclasses import dataclass

import casadi
import jax.numpy as jnp
import numpy as np
import pytest
from systems import model

from simpel_cli.dynamics.transition import encoding_of, transition
from simulators.model import Model, ModelError
from simulators.parameters import draw
from simulators.sergio import Genes, Sergio, rate
from simulators.worlds.rk4 import RK4

X = np.array([[100.0, 20], [250, 60], [400, 10]])
K = [[3.0, -2.0], [-4.0, 1.5]]  # rows: regulators
HIGH = {"lambda": (0.78, 0.76), "b": (2.0, 4.0)}
CLOSE = {"rtol": 1.01e-9, "atol": 1e-12}


def constants(fidelity: str) -> Genes:
    if fidelity == "low":
        return Genes(casadi.DM([[0.6, 0.5]]), casadi.DM([[2, 4]]), [casadi.DM([[3, -1.5]])])
    return Genes(casadi.DM([[0.78, 0.76]]), casadi.DM([[2, 4]]), [casadi.DM([[3, -2]]), casadi.DM([[0, 1.5]])])


@dataclass(frozen=True)
class Four(Sergio):
    """The check's four cells, whose quantiles are given and not standardised."""

    def quantiles(self) -> np.ndarray:
        return np.array([[-1.3, 0.4], [-0.4, -1.3], [0.4, 1.3], [1.3, -0.4]])


def four() -> Model:
    return Four(name="four", dt=0.1, substeps=1, genes=2, cells=4, x_max=500.0).model()


def parameters(source: Model) -> np.ndarray:
    """The check's constants; an edge is there where M is below one half."""
    values = {"lambda_1": 0.78, "lambda_2": 0.76, "b_1": 2.0, "b_2": 4.0, "M_1_2": 0.0, "M_2_1": 1.0}
    values |= {f"K_{r + 1}_{g + 1}": K[r][g] for r in range(2) for g in range(2)}
    return np.array([values[q.name] for q in source.params])


@pytest.mark.parametrize(
    ("fidelity", "rates", "following"),
    [
        ("high", [-75.5862069, -9.014323607, -191.5, -39.4, -307.8426966, -2.888202247],
         [92.72868874, 19.13232167, 231.5778148, 56.20578946, 370.3856919, 9.722271803]),
        ("low", [-57.14285714, -5.1, -146.5, -25.5, -236.1538462, 0.125],
         [94.4538115, 19.50239162, 235.7808433, 57.51284369, 377.0791061, 10.01170744]),
    ],
    ids=["S1", "S2"],
)  # fmt: skip
def test_cells(fidelity: str, rates: list[float], following: list[float]) -> None:
    def f(x: np.ndarray) -> np.ndarray:
        return np.asarray(rate(casadi.DM(x), constants(fidelity), fidelity))

    np.testing.assert_allclose(f(X).ravel(), rates, **CLOSE)
    h, k1 = 0.1, f(X)
    k2 = f(X + h / 2 * k1)
    k3 = f(X + h / 2 * k2)
    k4 = f(X + h * k3)
    np.testing.assert_allclose((X + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).ravel(), following, **CLOSE)


@pytest.mark.parametrize(
    ("state", "cells", "back", "following"),
    [
        ([0.5, -1, -1, 0.8],
         [257.7299839, 205.7033555, 281.2246104, 39.79742786, 302.1087229, 293.5359055, 325.6033495, 127.6299778], None,
         [0.241409581, -1.139812648, -1.134511674, 0.6106121098]),
        ([2.5, -2.8, 1, 2], [316.0633172, 87.56426703, 414.5579437, 0, 500, 247.0838679, 500, 0],
         [2.191863783, -1.996055595, 0.3945956865, 0.856980779],
         [1.806304085, -2.063118041, 0.2781013965, 0.7291405162]),
    ],
    ids=["S3", "S4"],
)  # fmt: skip
def test_populations(state: list[float], cells: list[float], back: list[float] | None, following: list[float]) -> None:
    source = four()
    flow, phi = source.flow(), parameters(source)
    assert flow.enter is not None
    assert flow.leave is not None
    z = flow.enter(state, phi)
    np.testing.assert_allclose(np.asarray(z).reshape(2, 4).T.ravel(), cells, **CLOSE)
    if back is not None:
        np.testing.assert_allclose(np.asarray(flow.leave(z, phi)).ravel(), back, **CLOSE)
    found = RK4(source).step(np.array([state], float), np.zeros((1, 0)), phi[None])
    np.testing.assert_allclose(found[0], following, **CLOSE)
    y = transition(source, encoding_of(source)).step(jnp.array(state, float), jnp.asarray(phi))
    np.testing.assert_allclose(np.array(state) + y, following, **CLOSE)


def drawn(source: Model, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    low, high = np.array([(q.low, q.high) for q in source.states]).T
    return rng.uniform(low, high, (n, len(low))), draw(source.params, rng, n)


def test_what_is_put_in_comes_out() -> None:
    """Standardised quantiles and no cell at the edge: decode and encode is the identity."""
    source = Sergio(name="s", dt=0.5, genes=3, cells=64).model()
    flow = source.flow()
    state = np.array([0.3, -0.5, 0.1, -1.0, -0.5, -2.0])
    assert flow.enter is not None
    assert flow.leave is not None
    phi = np.zeros(len(source.params))
    np.testing.assert_allclose(np.asarray(flow.leave(flow.enter(state, phi), phi)).ravel(), state, rtol=1e-12)


def test_quantiles_have_mean_zero_and_variance_one() -> None:
    eps = Sergio(name="s", dt=0.5, cells=64).quantiles()
    np.testing.assert_allclose(eps.mean(axis=0), 0, atol=1e-15)
    np.testing.assert_allclose((eps**2).mean(axis=0), 1, rtol=1e-12)
    assert not np.array_equal(eps[:, 0], eps[:, 1])
    assert np.array_equal(np.sort(eps[:, 0]), np.sort(eps[:, 1]))


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_cells_may_change_places(fidelity: str) -> None:
    order = np.array([2, 0, 1])
    one = np.asarray(rate(casadi.DM(X), constants(fidelity), fidelity))
    np.testing.assert_allclose(
        np.asarray(rate(casadi.DM(X[order]), constants(fidelity), fidelity)), one[order], rtol=1e-12
    )


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_without_regulation_cells_decay_towards_the_basal_expression(fidelity: str) -> None:
    """K = 0: X(t) = b/lambda + (X0 - b/lambda) exp(-lambda t), which mean and spread of unclipped cells tell exactly."""
    source = Sergio(
        name="s", dt=0.5, substeps=20, fidelity=fidelity, genes=2, cells=16, strength=(-1e-12, 1e-12)
    ).model()
    phi = np.array(
        [0.5 if q.name.startswith("lambda") else 3.0 if q.name.startswith("b_") else 0.0 for q in source.params]
    )
    state = np.array([[0.5, -0.2, -0.5, -1.0]])
    found = RK4(source).step(state, np.zeros((1, 0)), phi[None])[0]
    keep = np.exp(-0.5 * 0.5)
    rest = 6 * (3.0 / 0.5 / 50.0 - 0.5)
    softplus = np.log1p(np.exp(state[0, 2:])) * keep
    np.testing.assert_allclose(found[:2], rest + (state[0, :2] - rest) * keep, rtol=1e-7)
    np.testing.assert_allclose(found[2:], np.log(np.expm1(softplus)), rtol=1e-7)


def test_low_fidelity_is_the_diagonal_of_linear_regulation() -> None:
    """A gene does not act on another: its mean and spread follow from its own alone. In the network they do not."""
    for fidelity, apart in (("low", True), ("high", False)):
        source = Sergio(name="s", dt=0.5, fidelity=fidelity, genes=3, cells=16).model()
        x, phi = drawn(source, 1)
        phi[:, [q.name.startswith("M_") for q in source.params]] = 0.0  # every edge is there
        other = x.copy()
        other[0, [1, 4]] += 0.4
        one, two = (RK4(source).step(s, np.zeros((1, 0)), phi)[0] for s in (x, other))
        same = np.abs(one - two)[[0, 2, 3, 5]].max() < 1e-12
        assert same == apart


def test_shared_constants_are_those_of_cells_that_agree() -> None:
    known = {"name": "s", "dt": 0.5, "genes": 2, "cells": 8}
    shared, own = Sergio(**known).model(), Sergio(**known, shared=False).model()
    x, phi = drawn(shared, 5)
    of_cells = np.column_stack([
        phi[:, [q.name for q in shared.params].index("_".join(q.name.split("_")[: -1 if q.name[0] != "M" else None]))]
        for q in own.params
    ])  # fmt: skip
    none = np.zeros((5, 0))
    np.testing.assert_allclose(RK4(own).step(x, none, of_cells), RK4(shared).step(x, none, phi), rtol=1e-12)


def test_rates_of_the_states_are_those_of_the_cells() -> None:
    source = Sergio(name="s", dt=1e-6, substeps=1, genes=3, cells=16).model()
    x, phi = drawn(source, 4)
    x[:, 3:] = -np.abs(x[:, 3:]) / 2  # few cells at the edge, whose number must not change
    none = np.zeros((4, 0))
    flow = source.flow()
    assert flow.enter is not None
    assert flow.leave is not None
    before = np.array([np.asarray(flow.leave(flow.enter(*row), row[1])).ravel() for row in zip(x, phi, strict=True)])
    found = (RK4(source).step(x, none, phi) - before) / 1e-6
    rates = np.asarray(source.function().map(4)(x.T, none.T, phi.T)[0]).T
    np.testing.assert_allclose(found, rates, rtol=1e-4, atol=1e-4)


def test_expression_never_becomes_negative() -> None:
    """A gene that is drained (negative basal production) ends at zero in every cell, mean -3, not below."""
    source = Sergio(name="s", dt=0.5, substeps=1, genes=1, cells=4, basal=(-60.0, -50.0)).model()
    x, phi = np.array([[-1.5, -2.0]]), np.array([[0.5, -55.0, 0.0]])
    if [q.name[0] for q in source.params] != ["l", "b", "K"]:
        raise AssertionError(source.params)
    drained = RK4(source).step(x, np.zeros((1, 0)), phi)
    assert drained[0, 0] == pytest.approx(-3)
    assert drained[0, 1] < -10  # no spread


@pytest.mark.parametrize(
    "sim", ["sergio", "sergio_high_fidelity", "sergio_published", "sergio_published_high_fidelity"]
)
def test_every_setting_moves(sim: str) -> None:
    source = model(sim)
    x, phi = drawn(source, 3)
    moved = RK4(source).step(x, np.zeros((3, 0)), phi) - x
    assert np.isfinite(moved).all()
    assert (np.abs(moved).max(axis=0) > 1e-3).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"fidelity": "medium"}, r"sim\.fidelity: 'medium' is not allowed, only low or high"),
        ({"genes": 0}, r"sim\.genes: 0 is not allowed; give at least 1"),
        ({"decay": (0.8, 0.4)}, r"sim\.decay\.range: low = 0\.8 is not below high = 0\.4; swap them"),
        ({"connected": 1.5}, r"sim\.connected: 1\.5 is no probability"),
        ({"gap": {"sigma": 1}}, r"sim\.gap\.sigma: unknown key; allowed: mu, s"),
    ],
)
def test_wrong_words_are_refused(words: dict[str, object], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        Sergio(name="s", dt=0.5, **words)  # type: ignore[arg-type]
