"""The one-step map: sanity values of SYSTEMS.md, stacked actions, and every symbolic simulator against CasADi."""

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import SYMBOLIC, model

from simpel_cli.dynamics.casadi_jax import to_jax
from simpel_cli.dynamics.domain import Domain
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import ConfigError
from simulators.model import Declared, Model
from simulators.parameters import draw
from simulators.step import one_step

NOMINAL = {"m": 1.0, "l": 1.0, "C_m": 1.0}
DRAG = {"c_1": 0.5, "c_2": 0.5}
P4 = {"m": 0.6, "l": 1.4, "C_m": 1.0, "c_1": 0.45, "c_2": 0.55}


def vector(m: Model, values: dict[str, float]) -> jax.Array:
    assert {q.name for q in m.params} == values.keys()
    return jnp.array([values[q.name] for q in m.params])


@pytest.mark.parametrize(
    ("sim", "known", "values", "start", "u", "expected"),
    [
        ("pendulum", {}, NOMINAL, [0.3, 1.2], 0.5, [0.3644904543, 1.384600314]),
        ("pendulum_published", {}, {"m": 1, "l": 1, "g": 9.81}, [0.3, 1.2], 0.5, [0.3644904543, 1.384600314]),
        ("pendulum_high_fidelity", {}, NOMINAL | DRAG, [0.3, -3.0], 0.0, [0.1599718958, -2.622635401]),
        ("pendulum_high_fidelity", {}, NOMINAL | DRAG, [0.3, 3.0], 0.0, [0.4468862968, 2.889769756]),
        ("pendulum_high_fidelity", {"g": 12.0}, P4, [3.1, 4.5], -2.5, [-2.991276996, 3.271074257]),
        ("pendulum_high_fidelity", {}, NOMINAL | DRAG, [0.0, 0.0], 0.0, [0.0, 0.0]),
    ],
    ids=["P1", "P1-published", "P2", "P3", "P4", "P5"],
)
def test_sanity_values_of_the_pendulum(
    sim: str, known: dict[str, float], values: dict[str, float], start: list[float], u: float, expected: list[float]
) -> None:
    m = model(sim, **known)
    assert (m.dt, m.substeps) == (0.05, 5)
    encoding = encoding_of(m)
    s = jnp.array(start)
    x = encoding.to_x(s, jnp.array([u]))
    y = transition(m, encoding).step(x, vector(m, values))
    np.testing.assert_allclose(encoding.decode(x[:3] + y), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(y, encoding.encode(jnp.array(expected)) - encoding.encode(s), rtol=2e-9, atol=1e-9)


def test_sanity_values_of_the_sinusoids() -> None:
    m = model("sinusoids")
    values = {"a": 2.1, "w": 1.9, "c": -0.4, "w2": 1.5}
    both = transition(m, encoding_of(m, ("f", "f2"))).step(jnp.array([1.3]), vector(m, values))
    np.testing.assert_allclose(both, [0.7866904662, -0.2573797458], rtol=1e-9)
    second = transition(m, encoding_of(m, ("f2",))).step(jnp.array([1.3]), vector(m, values))
    np.testing.assert_allclose(second, both[1:], rtol=0)


def test_of_stacked_actions_the_last_acts() -> None:
    m = model("pendulum")
    phi = vector(m, NOMINAL)
    state = jnp.array([0.3, 1.2])
    plain = transition(m, encoding_of(m)).step(encoding_of(m).to_x(state, jnp.array([0.5])), phi)
    encoding = encoding_of(m, stack=2)
    step = transition(m, encoding).step
    stacked = step(encoding.to_x(state, jnp.array([-2.0, 1.5, 0.5])), phi)
    np.testing.assert_allclose(stacked, plain, rtol=0)
    slope = jax.jacfwd(step)(encoding.to_x(state, jnp.array([-2.0, 1.5, 0.5])), phi)[:, 3:]
    np.testing.assert_array_equal(slope[:, :2], 0)
    assert abs(slope[2, 2]) > 0.01  # a volt for 0.05 s, on I = 1 kg m^2


# a published setting has the equations of the other one
EVERY = [
    pytest.param(s, marks=[pytest.mark.slow] if "_published" in s and s != "pendulum_published" else [])
    for s in SYMBOLIC
]


@pytest.mark.parametrize("sim", EVERY)
def test_simulators_agree_with_casadi(sim: str) -> None:
    """Right-hand sides and outputs to 1e-12, their Jacobians to 1e-9, at points of the declared ranges."""
    m = model(sim)
    function = m.function()
    rng = np.random.default_rng(3)
    groups = [np.array([[q.low, q.high] for q in g]).reshape(-1, 2) for g in (m.states, m.inputs)]
    n = 20 if len(m.params) < 1000 else 2
    x, u = (rng.uniform(g[:, 0], g[:, 1], (n, len(g))) for g in groups)
    p = draw(m.params, rng, n)
    symbols = [function.sx_in(i) for i in range(3)]
    both = casadi.vertcat(*function(*symbols))
    jacobian = casadi.Function("J", symbols, [casadi.jacobian(both, casadi.vertcat(*symbols))])
    sizes = np.cumsum([len(m.states), len(m.inputs)])

    def ours(z: jax.Array) -> jax.Array:
        return jnp.concatenate(to_jax(function)(*jnp.split(z, sizes)))

    points = np.column_stack([x, u, p])
    value, forward, reverse = jax.jit(jax.vmap(lambda z: (ours(z), jax.jacfwd(ours)(z), jax.jacrev(ours)(z))))(points)
    expected = np.stack([casadi.vertcat(*function(*row)).full().ravel() for row in zip(x, u, p, strict=True)])
    slopes = np.stack([jacobian(*row).full() for row in zip(x, u, p, strict=True)])
    np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(forward, slopes, rtol=1e-9, atol=1e-9 * np.abs(slopes).max())
    np.testing.assert_allclose(reverse, slopes, rtol=1e-9, atol=1e-9 * np.abs(slopes).max())


@pytest.mark.parametrize("sim", EVERY)
def test_simulators_step_in_batches(sim: str) -> None:
    """Every symbolic simulator gives finite targets over its domain, and keeps angles on the unit circle."""
    m = model(sim)
    encoding = encoding_of(m, tuple(q.name for q in m.outputs), m.past())
    bound = transition(m, encoding)
    x = Domain(encoding).sample(jax.random.key(0), 16, jnp.float64)
    phi = jnp.asarray(draw(m.params, np.random.default_rng(0), 16))
    y = jax.jit(jax.vmap(bound.step))(x, phi)
    assert y.shape == (16, encoding.dim_y)
    assert np.isfinite(y).all()
    after = x[:, : encoding.dim_state] + y[:, : encoding.dim_state]
    np.testing.assert_allclose(encoding.encode(encoding.decode(after)), after, atol=1e-12)


def late(delay: float, lag: float) -> Model:
    return Declared(
        "late", dt=0.1, substeps=50,
        states={"v": {"unit": "m/s", "range": [-2, 2]}},
        inputs={"u": {"unit": "V", "range": [-1, 1], "delay": delay, "lag": lag}},
        parameters={"a": 0.7}, dynamics={"v": "u - a*v"},
    ).model()  # fmt: skip


def test_a_transition_with_a_delay_is_the_exact_solution() -> None:
    model = late(0.13, 0.0)
    step = transition(model, encoding_of(model, stack=2)).step
    v, (oldest, older, _) = 0.4, (0.9, -0.5, 0.2)
    for u, seconds in ((oldest, 0.03), (older, 0.07)):  # what arrives in 0.1 s
        v = u / 0.7 + (v - u / 0.7) * np.exp(-0.7 * seconds)
    found = step(jnp.array([0.4, 0.9, -0.5, 0.2]), jnp.zeros(0))
    np.testing.assert_allclose(found, [v - 0.4], rtol=2e-3)


def test_a_delay_needs_the_inputs_of_the_past() -> None:
    model = late(0.13, 0.0)
    with pytest.raises(ConfigError, match=r"data\.stack_actions: 1, but .* Use data\.stack_actions=2\."):
        transition(model, encoding_of(model, stack=1))


@pytest.mark.parametrize("substeps", [1, 3, 4])
def test_a_root_is_defined_where_a_late_input_keeps_to_its_range(substeps: int) -> None:
    """Not even by what was rounded is it beyond: in a transition, and in the function that optimisers get."""
    model = Declared(
        "tank", dt=0.1, substeps=substeps, states={"h": {"unit": "m", "range": [0, 2]}},
        inputs={"u": {"unit": "V", "range": [0, 1], "delay": 0.13}}, parameters={}, dynamics={"h": "sqrt(u) - h"},
    ).model()  # fmt: skip
    random, ahead, exported = np.random.default_rng(0), transition(model, encoding_of(model, stack=2)), one_step(model)
    x = np.concatenate([random.uniform(0, 2, (60, 1)), random.choice([0.0, 0.3, 1.0], (60, 3))], axis=1)
    found = np.asarray(jax.vmap(ahead.step, in_axes=(0, None))(jnp.asarray(x), jnp.zeros(0)))
    assert np.isfinite(found).all()
    expected = [float(exported(row[0], row[1:], [])[0]) - row[0] for row in x]
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-6)
