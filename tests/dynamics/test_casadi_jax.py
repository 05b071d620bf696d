"""The interpreter against CasADi: values, Jacobians, conditionals, refusals."""

import math
from collections.abc import Callable

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.dynamics import casadi_operations
from simpel_cli.dynamics.casadi_jax import ConversionError, _feeds_branch, _Step, checked, to_jax
from simpel_cli.errors import ConfigError

SCALAR: dict[str, Callable[..., casadi.SX]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a, b: -a,
    "exp": lambda a, b: casadi.exp(a),
    "log": lambda a, b: casadi.log(a),
    "pow": lambda a, b: a**b,
    "constpow": lambda a, b: a**2.7,
    "integer_power": lambda a, b: (a - 1) ** 3,
    "sqrt": lambda a, b: casadi.sqrt(a),
    "sq": lambda a, b: (a - 1) ** 2,
    "twice": lambda a, b: 2 * a,
    "inv": lambda a, b: 1 / a,
    "sin": lambda a, b: casadi.sin(a),
    "cos": lambda a, b: casadi.cos(a),
    "tan": lambda a, b: casadi.tan(a),
    "asin": lambda a, b: casadi.asin(a / 2),
    "acos": lambda a, b: casadi.acos(a / 2),
    "atan": lambda a, b: casadi.atan(a),
    "atan2": lambda a, b: casadi.atan2(a - 1, b - 1),
    "sinh": lambda a, b: casadi.sinh(a),
    "cosh": lambda a, b: casadi.cosh(a),
    "tanh": lambda a, b: casadi.tanh(a),
    "asinh": lambda a, b: casadi.asinh(a),
    "acosh": lambda a, b: casadi.acosh(a + 1),
    "atanh": lambda a, b: casadi.atanh(a / 2),
    "lt": lambda a, b: (a < b) + 0 * a,
    "le": lambda a, b: (a <= b) * a,
    "eq": lambda a, b: (a == b) + (a == a + 0 * b) * a,
    "ne": lambda a, b: (a != b) * a,
    "not": lambda a, b: casadi.logic_not(a < b) * a,
    "and": lambda a, b: casadi.logic_and(a < b, a > 1) * a,
    "or": lambda a, b: casadi.logic_or(a < b, a > 1) * a,
    "floor": lambda a, b: casadi.floor(3 * a) * b,
    "ceil": lambda a, b: casadi.ceil(3 * a) * b,
    "fmod": lambda a, b: casadi.fmod(3 * a, b),
    "remainder": lambda a, b: casadi.remainder(3 * a, b),
    "fabs": lambda a, b: casadi.fabs(a - 1),
    "sign": lambda a, b: casadi.sign(a - 1) * b,
    "copysign": lambda a, b: casadi.copysign(a, b - 1),
    "erf": lambda a, b: casadi.erf(a),
    "erfinv": lambda a, b: casadi.erfinv(a / 2),
    "fmin": lambda a, b: casadi.fmin(a, b),
    "fmax": lambda a, b: casadi.fmax(a, b),
    "log1p": lambda a, b: casadi.log1p(a),
    "expm1": lambda a, b: casadi.expm1(a),
    "hypot": lambda a, b: casadi.hypot(a, b),
    "if_else": lambda a, b: casadi.if_else(a < b, casadi.sin(a) * b, a / b),
    "tiny_constant": lambda a, b: 1.234567890123456e-20 * a,
}


def matrix_power(a: casadi.MX) -> casadi.MX:
    return casadi.mac(a, a, a)


def written_twice(a: casadi.MX, v: casadi.MX) -> casadi.MX:
    b = casadi.MX(a)
    b[[0, 0, 1], 0] = v  # the last of two writes to one place counts
    b[:, 2] = casadi.sin(v)
    return b


def inlined(build: Callable[..., casadi.MX], *values: casadi.MX) -> casadi.MX:
    """Differentiate with respect to plain symbols, as CasADi asks, then put in the values."""
    symbols = [casadi.MX.sym(f"s{k}", value.shape) for k, value in enumerate(values)]
    return casadi.Function("g", symbols, [build(*symbols)], {"always_inline": True})(*values)


def gradient_of_gather(v: casadi.MX) -> casadi.MX:
    return casadi.gradient(casadi.dot(v[[0, 0, 1]], v**2), v)


def call(v: casadi.MX, kind: type, over: Callable[[casadi.Function], casadi.Function] = lambda f: f) -> casadi.MX:
    x, y = kind.sym("x", 3), kind.sym("y", 1)
    inner = casadi.Function("inner", [x, y], [casadi.sin(x) * y, x[1] + y], {"never_inline": True})
    return casadi.vertcat(*(casadi.vec(out) for out in over(inner)(v, v[0])))


def switch(v: casadi.MX, w: casadi.MX) -> casadi.MX:
    return casadi.conditional(3 * v[0], [v * w, casadi.sin(w)], v - w, True)


def solve_transposed(a: casadi.MX, v: casadi.MX, w: casadi.MX) -> casadi.MX:
    return casadi.jtimes(casadi.solve(a, v), v, w, True)


def diagsplit(a: casadi.MX, v: casadi.MX) -> casadi.MX:
    first, second = casadi.diagsplit(casadi.diagcat(casadi.sin(a), v), [0, 3, 6], [0, 3, 4])
    return casadi.horzcat(first, second)


def repsum(v: casadi.MX, w: casadi.MX) -> casadi.MX:
    wide = casadi.repmat(casadi.sin(v), 1, 4)
    return casadi.jtimes(wide * casadi.repmat(w, 1, 4), v, casadi.repmat(w, 1, 4), True)


# a, s: 3 x 3 dense and lower triangular; v, w: columns of 3. All entries in [0.2, 1.8], the diagonals dominate.
MATRIX: dict[str, Callable[..., casadi.MX]] = {
    "cross": lambda a, s, v, w: casadi.cross(v, w),
    "cross_of_columns": lambda a, s, v, w: casadi.cross(a[:, 0], casadi.mtimes(a, w)),
    "elementwise": lambda a, s, v, w: casadi.sin(a) * v[0] + a / 3,
    "sparse_elementwise": lambda a, s, v, w: casadi.sin(s) * 2 + s * s,
    "sparse_densified": lambda a, s, v, w: casadi.cos(s) + a,
    "mtimes": lambda a, s, v, w: casadi.mtimes(a, v),
    "mtimes_sparse": lambda a, s, v, w: casadi.mtimes(s, casadi.mtimes(s, a)),
    "mac": lambda a, s, v, w: matrix_power(a),
    "transpose": lambda a, s, v, w: a.T,
    "transpose_sparse": lambda a, s, v, w: s.T,
    "solve": lambda a, s, v, w: casadi.solve(a, v),
    "solve_transposed": lambda a, s, v, w: inlined(solve_transposed, a, v, w),
    "solve_triangular": lambda a, s, v, w: casadi.solve(s, v),
    "det": lambda a, s, v, w: casadi.det(a),
    "inverse": lambda a, s, v, w: casadi.inv(a),
    "dot": lambda a, s, v, w: casadi.dot(v, w),
    "bilin": lambda a, s, v, w: casadi.bilin(a, v, w),
    "rank1": lambda a, s, v, w: casadi.rank1(a, v[1], v, w),
    "kron": lambda a, s, v, w: casadi.kron(a, v),
    "norm_1": lambda a, s, v, w: casadi.norm_1(v - 1),
    "norm_2": lambda a, s, v, w: casadi.norm_2(v),
    "norm_inf": lambda a, s, v, w: casadi.norm_inf(v - 1),
    "norm_fro": lambda a, s, v, w: casadi.norm_fro(a),
    "mmin": lambda a, s, v, w: casadi.mmin(v),
    "mmax": lambda a, s, v, w: casadi.mmax(v),
    "logsumexp": lambda a, s, v, w: casadi.logsumexp(v),
    "horzcat": lambda a, s, v, w: casadi.horzcat(v, casadi.sin(a), s),
    "vertcat": lambda a, s, v, w: casadi.vertcat(casadi.sin(v), w, v[0] * w),
    "diagcat": lambda a, s, v, w: casadi.diagcat(v, casadi.sin(s)),
    "horzsplit": lambda a, s, v, w: casadi.horzcat(*reversed(casadi.horzsplit(casadi.sin(a), [0, 1, 3]))),
    "vertsplit": lambda a, s, v, w: casadi.vertcat(*reversed(casadi.vertsplit(casadi.sin(v), [0, 1, 3]))),
    "diagsplit": lambda a, s, v, w: diagsplit(a, v),
    "reshape": lambda a, s, v, w: casadi.reshape(casadi.sin(a), 1, 9),
    "getnonzeros": lambda a, s, v, w: casadi.sin(a)[[2, 0], [1, 2]],
    "getnonzeros_sparse": lambda a, s, v, w: s[1, :] + a[:, 1].T,
    "setnonzeros": lambda a, s, v, w: written_twice(a, v),
    "addnonzeros": lambda a, s, v, w: inlined(gradient_of_gather, v),
    "project": lambda a, s, v, w: casadi.tril(casadi.sin(a)),
    "sums": lambda a, s, v, w: casadi.sum1(a) + casadi.sum2(a).T + casadi.trace(a),
    "repmat": lambda a, s, v, w: casadi.repmat(casadi.sin(v), 1, 3) * a,
    "repsum": lambda a, s, v, w: inlined(repsum, v, w),
    "cumsum": lambda a, s, v, w: casadi.cumsum(v),
    "if_else": lambda a, s, v, w: casadi.if_else(v[0] < w[0], casadi.sin(a), a * v[1]),
    "if_else_elementwise": lambda a, s, v, w: casadi.if_else(v < w, casadi.sqrt(v), w),
    "switch": lambda a, s, v, w: switch(v, w),
    "short_circuit": lambda a, s, v, w: casadi.if_else(v[0] < 1, v * w, casadi.sin(w), True),
    "call_sx": lambda a, s, v, w: call(v, casadi.SX),
    "call_mx": lambda a, s, v, w: call(v, casadi.MX),
    "map": lambda a, s, v, w: call(a, casadi.SX, lambda f: f.map(3)),
    "constant": lambda a, s, v, w: casadi.DM([[1, 2, 3], [4, 5, 6], [0, 0, 7]]) @ v + casadi.MX(3),
}


Point = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def matrix_symbols() -> tuple[casadi.MX, casadi.MX, casadi.MX, casadi.MX]:
    return (
        casadi.MX.sym("a", 3, 3),
        casadi.MX.sym("s", casadi.Sparsity.lower(3)),
        casadi.MX.sym("v", 3),
        casadi.MX.sym("w", 3),
    )


def matrix_point(seed: int = 0) -> Point:
    random = np.random.default_rng(seed)
    a, s = (random.uniform(0.2, 0.8, (3, 3)) + np.eye(3) for _ in range(2))
    return a, np.tril(s), random.uniform(0.2, 1.8, 3), random.uniform(0.2, 1.8, 3)


def assert_close(ours: jax.Array, theirs: casadi.DM, tolerance: float) -> None:
    expected = theirs.full()
    assert np.all(np.isfinite(expected))
    atol = tolerance * np.max(np.abs(expected), initial=0)
    np.testing.assert_allclose(np.asarray(ours).reshape(expected.shape), expected, rtol=0, atol=atol)


def scalar_function(build: Callable[..., casadi.SX]) -> casadi.Function:
    x = casadi.SX.sym("x", 2)
    return casadi.Function("f", [x], [build(x[0], x[1])])


def assert_values_and_jacobian(function: casadi.Function, points: np.ndarray, tolerance: float = 1e-12) -> None:
    """Compare a function of one column, with one output column, with CasADi at several points."""
    z = casadi.MX.sym("z", points.shape[1])
    jacobian = casadi.Function("J", [z], [casadi.jacobian(function(z), z)])

    def ours(x: jax.Array) -> jax.Array:
        return to_jax(function)(x)[0]

    everything = jax.jit(jax.vmap(lambda x: (ours(x), jax.jacrev(ours)(x), jax.jacfwd(ours)(x))))
    for x, value, reverse, forward in zip(points, *everything(points), strict=True):
        assert_close(value, function(x), tolerance)
        assert_close(reverse, jacobian(x), 1e-9)
        assert_close(forward, jacobian(x), 1e-9)


@pytest.mark.parametrize("name", SCALAR)
def test_scalar_operation(name: str) -> None:
    points = np.random.default_rng(1).uniform(0.2, 1.8, (5, 2))
    # CasADi's own erfinv is good to 4e-10 only (against SciPy's)
    assert_values_and_jacobian(scalar_function(SCALAR[name]), points, 1e-9 if name == "erfinv" else 1e-12)


def test_scalar_operations_cover_the_table() -> None:
    """Each elementwise operation in the table is reached by a case above; OP_LIFT and OP_ASSIGN are never in SX."""
    functions = [scalar_function(build) for build in SCALAR.values()]
    seen = {f.instruction_id(k) for f in functions for k in range(f.n_instructions())}
    assert set(casadi_operations._ELEMENTWISE) - seen == {casadi.OP_LIFT, casadi.OP_ASSIGN}


@pytest.mark.parametrize("name", MATRIX)
def test_matrix_operation(name: str) -> None:
    symbols = matrix_symbols()
    function = casadi.Function("f", symbols, [MATRIX[name](*symbols)])
    points = [matrix_point(seed) for seed in range(3)]
    (batch,) = jax.jit(jax.vmap(to_jax(function)))(*(np.stack(values) for values in zip(*points, strict=True)))
    rows, columns = function.size_out(0)
    assert batch.shape[1:] == ((rows,) if columns == 1 else (rows, columns))
    for ours, point in zip(batch, points, strict=True):
        assert_close(ours, function(*point), 1e-12)


@pytest.mark.parametrize("name", MATRIX)
def test_matrix_operation_jacobian(name: str) -> None:
    z = casadi.MX.sym("z", 21)
    s = casadi.MX(casadi.Sparsity.lower(3), z[9:15])
    result = MATRIX[name](casadi.reshape(z[:9], 3, 3), s, z[15:18], z[18:])
    points = [
        np.concatenate([a.T.ravel(), lower.T[np.triu_indices(3)], v, w])
        for a, lower, v, w in map(matrix_point, range(3))
    ]
    assert_values_and_jacobian(casadi.Function("f", [z], [casadi.densify(casadi.vec(result))]), np.stack(points))


def test_cross_product_is_right() -> None:
    v, w = casadi.MX.sym("v", 3), casadi.MX.sym("w", 3)
    (ours,) = to_jax(casadi.Function("f", [v, w], [casadi.cross(v, w)]))(jnp.array([1.0, 2, 3]), jnp.array([4.0, 5, 7]))
    np.testing.assert_array_equal(ours, [-1, 5, -3])


def test_several_pieces_of_inputs_and_outputs() -> None:
    v, s = casadi.MX.sym("v", 3), casadi.MX.sym("s")
    outputs = [casadi.vertcat(s, v), casadi.horzcat(2 * v, v), casadi.MX(0, 1)]
    function = casadi.Function("f", [casadi.vertcat(v, s), casadi.MX.sym("nothing", 0)], outputs)
    first, second, empty = to_jax(function)(jnp.array([1.0, 2, 3, 4]), jnp.zeros(0))
    np.testing.assert_array_equal(first, [4, 1, 2, 3])
    np.testing.assert_array_equal(second, [[2, 1], [4, 2], [6, 3]])
    assert empty.shape == (0,)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_in_is_dtype_out(dtype: jnp.dtype) -> None:
    x = casadi.SX.sym("x", 2)
    scalar = casadi.Function("f", [x], [casadi.if_else(x[0] > 1, 2.5 * x[1], x[0] > 0), casadi.SX(1.5)])
    symbols = matrix_symbols()
    everything = casadi.Function("g", symbols, [build(*symbols) for build in MATRIX.values()])
    for function, point in ((scalar, (np.ones(2),)), (everything, matrix_point())):
        results = to_jax(function)(*(jnp.asarray(value, dtype) for value in point))
        assert {result.dtype for result in results} == {jnp.dtype(dtype)}


def test_vmap_and_float32_without_x64() -> None:
    function = scalar_function(SCALAR["if_else"])
    points = np.random.default_rng(0).uniform(0.2, 1.8, (5, 2))
    expected = np.array([float(function(point)) for point in points])
    (ours,) = jax.vmap(to_jax(function))(jnp.asarray(points))
    np.testing.assert_allclose(ours[:, 0], expected, rtol=1e-12)
    with jax.enable_x64(False):
        (single,) = jax.vmap(to_jax(function))(jnp.asarray(points, jnp.float32))
        assert single.dtype == jnp.float32
        np.testing.assert_allclose(single[:, 0], expected, rtol=1e-5)
        checked(function, [[(0.2, 1.8), (0.2, 1.8)]])  # compares in float64 all the same


# Branches that are taken for x > 0 only, and whose slope at or below 0 is infinite or nan. The other branch is 3 x + 1.
UNTAKEN: dict[str, Callable[[casadi.SX], casadi.SX]] = {
    "sqrt": casadi.sqrt,
    "reciprocal": lambda x: 1 / x,
    "log": casadi.log,
    "division": lambda x: casadi.sin(x) / x,
    "power": lambda x: x**0.3,
    "power_of_itself": lambda x: x**x,
    "product_with_infinity": lambda x: x * casadi.log(x),
    "nested": lambda x: casadi.exp(1 / x) * casadi.sqrt(casadi.log(x)),
    "two_arguments": lambda x: casadi.atan2(x, casadi.fabs(x)) + casadi.hypot(x, x),
    "arc": lambda x: casadi.asin(1 - x) + casadi.acos(1 - x),
    "overflow": lambda x: casadi.exp(1 - 1e6 * x),
    "conditional_inside": lambda x: casadi.if_else(x < 1, casadi.sqrt(x), 1 / (x - 1)),
}


@pytest.mark.parametrize("kind", [casadi.SX, casadi.MX])
@pytest.mark.parametrize("name", UNTAKEN)
def test_untaken_branch_leaves_the_gradient_alone(name: str, kind: type) -> None:
    x = kind.sym("x")
    branch = UNTAKEN[name](x)
    function = casadi.Function("f", [x], [casadi.if_else(x > 0, branch, 3 * x + 1)])

    def ours(x: jax.Array) -> jax.Array:
        return to_jax(function)(x)[0]

    everything = jax.jit(lambda x: (ours(x), jax.jacrev(ours)(x), jax.jacfwd(ours)(x)))
    for point in (0.0, -0.7):
        value, reverse, forward = everything(jnp.array([point]))
        np.testing.assert_allclose(value, [3 * point + 1], rtol=1e-15)
        assert (reverse.item(), forward.item()) == (3.0, 3.0)
    inside = casadi.Function("d", [x], [branch, casadi.gradient(branch, x)])
    for point in (1.3, 1.8):  # a guard must not change the branch that is taken
        for mine, theirs in zip(everything(jnp.array([point])), inside(point), strict=False):
            assert_close(mine, theirs, 1e-9)


def test_untaken_branch_of_matrices_calls_and_elements() -> None:
    v = casadi.MX.sym("v", 2)
    inner = casadi.Function("inner", [v], [casadi.sqrt(v)], {"never_inline": True})
    branches = [
        inner(v),
        casadi.mtimes(casadi.diag(1 / v), v + 1),
        v / casadi.norm_2(v),
        casadi.solve(casadi.diag(v) + 0 * casadi.MX.ones(2, 2), v + 1),
    ]
    for branch in branches:
        function = casadi.Function("f", [v], [casadi.sum1(casadi.if_else(v[0] > 0, branch, 3 * v))])
        slope = jax.grad(lambda v, f=function: to_jax(f)(v)[0][0])
        np.testing.assert_array_equal(slope(jnp.zeros(2)), [3.0, 3.0])
        expected = casadi.Function("d", [v], [casadi.gradient(function(v), v)])
        assert_close(slope(jnp.array([0.3, 0.9])), expected([0.3, 0.9]), 1e-9)
    element = casadi.Function("f", [v], [casadi.sum1(casadi.if_else(v > 0, casadi.sqrt(v), 3 * v))])
    np.testing.assert_array_equal(jax.grad(lambda v: to_jax(element)(v)[0][0])(jnp.array([0.25, -1.0])), [1.0, 3.0])
    shortcut = casadi.Function("f", [v], [casadi.sum1(casadi.if_else(v[0] > 0, casadi.log(v), 3 * v, True))])
    np.testing.assert_array_equal(jax.grad(lambda v: to_jax(shortcut)(v)[0][0])(jnp.zeros(2)), [3.0, 3.0])


def test_infinite_slope_outside_a_conditional_stays_infinite() -> None:
    x = casadi.SX.sym("x")
    function = casadi.Function("f", [x], [casadi.log(x), casadi.if_else(x > 0, casadi.sin(2 * x) * casadi.cos(x), 0)])
    outside, inside = (jax.grad(lambda x, k=k: to_jax(function)(x)[k][0])(jnp.zeros(1)).item() for k in (0, 1))
    assert (outside, inside) == (math.inf, 0.0)


def test_branch_is_followed_through_reused_slots() -> None:
    steps = [
        _Step(casadi.OP_INPUT, (), (0,)),
        _Step(casadi.OP_LOG, (0,), (1,)),  # its slot is reused by the branch, its value is not in it
        _Step(casadi.OP_OUTPUT, (1,), ()),
        _Step(casadi.OP_SIN, (0,), (1,)),
        _Step(casadi.OP_IF_ELSE_ZERO, (0, 1), (2,)),
        _Step(casadi.OP_OUTPUT, (2,), ()),
    ]
    assert _feeds_branch(steps) == [True, False, False, True, False, False]


def test_tank_outflow_has_a_finite_slope_below_zero() -> None:
    h = casadi.SX.sym("h")
    function = casadi.Function("f", [h], [casadi.sqrt(casadi.fmax(h, 0)) + casadi.fmax(h, 0) ** 0.7 + 2 * h])
    slope = jax.grad(lambda h: to_jax(function)(h)[0][0])
    assert slope(jnp.array([-1.0]))[0] == 2.0
    np.testing.assert_allclose(slope(jnp.array([0.5]))[0], 2 + 0.5 * 0.5**-0.5 + 0.7 * 0.5**-0.3, rtol=1e-12)


def test_extremes_tie_as_in_casadi() -> None:
    x = casadi.SX.sym("x", 2)
    function = casadi.Function("f", [x], [casadi.fmin(x[0], x[1])])
    gradient = jax.grad(lambda x: to_jax(function)(x)[0][0])(jnp.ones(2))
    assert_close(gradient, casadi.Function("g", [x], [casadi.gradient(function(x), x)])([1, 1]), 1e-12)


def unsupported() -> dict[str, tuple[casadi.Function, str]]:
    v, s = casadi.MX.sym("v", 3), casadi.MX.sym("s")

    class Python(casadi.Callback):
        def __init__(self) -> None:
            casadi.Callback.__init__(self)
            self.construct("Python", {})

    callback = Python()
    table = casadi.interpolant("table", "linear", [[0, 1, 2]], [0, 1, 4])
    ode = {"x": v, "ode": -v}
    flow = casadi.integrator("flow", "rk", ode, 0, 1)
    root = casadi.rootfinder("root", "newton", casadi.Function("r", [s, v], [s**3 - v[0]]))
    return {
        "callback": (casadi.Function("f", [s], [callback(s)]), "PythonCallback|CallbackInternal"),
        "interpolant": (casadi.Function("f", [s], [table(s)]), "table: .*LinearInterpolant"),
        "integrator": (casadi.Function("f", [v], [flow(x0=v)["xf"]]), "flow: .*RungeKutta"),
        "rootfinder": (casadi.Function("f", [v], [root(1, v)]), "root: .*Newton"),
        "parametric_index": (casadi.Function("f", [v, s], [v[s]]), "f: .*OP_GETNONZEROS_PARAM"),
        "find": (casadi.Function("f", [v], [casadi.find(v)]), "f: .*OP_FIND"),
        "inverse_node": (casadi.Function("f", [v], [casadi.inv_node(casadi.diag(v) + v @ v.T)]), "f: .*OP_INVERSE"),
        "norm_2_of_matrix": (casadi.Function("f", [v], [casadi.norm_2(v @ v.T)]), "f: .*OP_NORM2"),
    }


@pytest.mark.parametrize(
    "name",
    [
        "callback",
        "interpolant",
        "integrator",
        "rootfinder",
        "parametric_index",
        "find",
        "inverse_node",
        "norm_2_of_matrix",
    ],
)
def test_unsupported_is_refused_by_name(name: str) -> None:
    function, message = unsupported()[name]
    with pytest.raises(ConversionError, match=f"(?s){message}.*no JAX counterpart.*rit"):
        to_jax(function)
    assert issubclass(ConversionError, ConfigError)


def test_checked_accepts_what_agrees() -> None:
    symbols = matrix_symbols()
    a, s, v, w = matrix_point()
    function = casadi.Function("f", symbols, [casadi.solve(symbols[0], symbols[2]), symbols[1] * 2, symbols[0].T])
    box = [[(0.2, 1.8)] * n for n in (9, 9, 3, 3)]
    converted = checked(function, box, points=4)
    for ours, theirs in zip(converted(a, s, v, w), function(a, s, v, w), strict=True):
        assert_close(ours, theirs, 1e-12)


def test_checked_takes_nan_and_infinity_for_equal() -> None:
    x, nothing = casadi.SX.sym("x", 2), casadi.SX.sym("nothing", 0)
    function = casadi.Function("f", [x, nothing], [casadi.vertcat(casadi.sqrt(x[0]), 1 / (0 * x[1]))])
    checked(function, [[(-1.0, 1.0), (1.0, 2.0)], []])


def test_checked_refuses_a_wrong_conversion(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(casadi_operations._ELEMENTWISE, casadi.OP_TAN, lambda a: jnp.sin(a) / jnp.cos(a) * (1 + 1e-7))
    x = casadi.SX.sym("x", 2)
    function = casadi.Function("wrong", [x], [x, casadi.tan(x)], ["x"], ["same", "slip"])
    with pytest.raises(ConversionError, match=r"wrong: output slip\[0\] is .* in JAX and .* in CasADi, at x = \[0\."):
        checked(function, [[(0.1, 0.9), (0.1, 0.9)]])
    checked(function, [[(0.1, 0.9), (0.1, 0.9)]], rtol=1e-6)


def test_checked_refuses_nan_in_one_of_the_two() -> None:
    x = casadi.SX.sym("x")
    function = casadi.Function("f", [x], [casadi.fmax(casadi.sqrt(x), 0)])  # C's fmax drops the nan
    with pytest.raises(ConversionError, match=r"nan.* in JAX and .*0.0.* in CasADi"):
        checked(function, [[(-2.0, -1.0)]])


def test_wrong_arguments_are_named() -> None:
    converted = to_jax(scalar_function(SCALAR["add"]))
    with pytest.raises(ValueError, match=r"argument i0 has shape \(4, 2\), expected \(2,\).*jax.vmap"):
        converted(jnp.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"2 argument.* given, expected 1: i0"):
        converted(jnp.zeros(2), jnp.zeros(2))
    with pytest.raises(TypeError, match="one floating dtype, got i0 int"):
        converted(jnp.zeros(2, int))
