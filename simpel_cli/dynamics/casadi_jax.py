"""CasADi functions as JAX functions: an interpreter of their instruction lists, scalar (SX) and matrix (MX) alike.

Every value is carried as the vector of its structural nonzeros, column by column, so a nested call is a list of vectors
in and a list of vectors out, whatever the callee is. The list is walked once per trace. XLA compiles an SX function in
about 3 ms per scalar instruction: write large vector models in MX.

Conditionals: CasADi's `if_else(c, a, b)` is a sum of terms `c ? a : 0`. Operations that feed one are guarded, so that
the branch which is not taken cannot put a nan into the gradient (see `casadi_operations`).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from simpel_cli.dynamics.casadi_operations import Program, Values, operation, projection, to_dense, to_nonzeros
from simpel_cli.errors import ConfigError


class ConversionError(ConfigError):
    """A CasADi function that cannot be run in JAX, or that came out different; names the function and the operation."""


def to_jax(function: casadi.Function) -> Callable[..., tuple[Array, ...]]:
    """Convert a CasADi function to a pure JAX function of one point; jit, vmap and grad apply.

    Args:
        function: made of SX or MX, or a map or switch of such.

    Returns:
        A function of as many arrays as `function` has inputs; it returns a tuple of as many as it has outputs. A column
        (n x 1) is an array of shape (n,), a scalar (1,), an empty one (0,), anything else is 2-D and dense. All
        arguments have one floating dtype, which the results get.

    Raises:
        ConversionError: an operation or a kind of function without a JAX counterpart, e.g. an integrator or a lookup.

    Example:
        >>> x = casadi.SX.sym("x", 2)
        >>> (y,) = to_jax(casadi.Function("f", [x], [casadi.sin(x)]))(jnp.zeros(2))

    """
    program = _program(function, guarded=False)
    inputs = [function.sparsity_in(i) for i in range(function.n_in())]
    outputs = [function.sparsity_out(i) for i in range(function.n_out())]

    def converted(*arguments: Any) -> tuple[Array, ...]:
        arrays = _arguments(function, arguments)
        operands = [to_nonzeros(array, sparsity) for array, sparsity in zip(arrays, inputs, strict=True)]
        results = program(operands, _dtype(function, arrays))
        dense = [to_dense(value, sparsity) for value, sparsity in zip(results, outputs, strict=True)]
        return tuple(value.reshape(_shape(sparsity)) for value, sparsity in zip(dense, outputs, strict=True))

    return converted


def to_jax_rows(function: casadi.Function) -> Callable[..., tuple[Array, ...]]:
    """Convert a function of columns to a JAX function of many points at once, which are its trailing axes.

    With the points last, every operation of an SX function is one pass over contiguous numbers.

    Args:
        function: its inputs are dense columns; of its outputs the structural nonzeros are returned.

    Returns:
        A function of arrays (n, ...) that returns, per output, the array (nonzeros, ...), column by column.

    """
    if function.class_name() != "SXFunction":
        return _rows_of_points(function)
    program = _program(function, guarded=False)

    def converted(*arguments: Any) -> tuple[Array, ...]:
        arrays = [jnp.asarray(a) for a in arguments]
        return tuple(program(list(arrays), _dtype(function, arrays)))

    return converted


def _rows_of_points(function: casadi.Function) -> Callable[..., tuple[Array, ...]]:
    """Do the same for matrix expressions, point by point under `vmap`."""
    program = _program(function, guarded=False)

    def point(*arrays: Array) -> tuple[Array, ...]:
        return tuple(program(list(arrays), _dtype(function, list(arrays))))

    def converted(*arguments: Any) -> tuple[Array, ...]:
        arrays = [jnp.asarray(a) for a in arguments]
        run = point
        for _ in range(max(a.ndim for a in arrays) - 1):
            run = jax.vmap(run, in_axes=-1, out_axes=-1)
        return run(*arrays)

    return converted


def checked(
    function: casadi.Function,
    ranges: Sequence[Sequence[tuple[float, float]]],
    *,
    points: int = 16,
    seed: int = 0,
    rtol: float = 1e-9,
) -> Callable[..., tuple[Array, ...]]:
    """Convert a function and compare it with CasADi, in float64 at random points; refuse a mismatch.

    Args:
        function: as for `to_jax`.
        ranges: for each input one (low, high) per element, column by column; points are uniform in this box.
        points: how many.
        seed: of the points.
        rtol: allowed difference, relative to the largest magnitude of that output element over the points, at least
            1e-6 (an output that cancels to zero still has rounding errors); nan is equal to nan.

    Returns:
        What `to_jax` returns.

    Raises:
        ConversionError: names the output element, the point and both values.

    """
    converted = to_jax(function)
    random = np.random.default_rng(seed)
    boxes = [np.asarray(box, dtype=np.float64).reshape(-1, 2) for box in ranges]
    samples = [random.uniform(box[:, 0], box[:, 1], (points, len(box))) for box in boxes]
    columns = [_shape(function.sparsity_in(i)) for i in range(function.n_in())]
    batches = [
        sample.reshape(points, *shape[::-1]).swapaxes(1, -1) for sample, shape in zip(samples, columns, strict=True)
    ]
    with jax.enable_x64(True):
        ours = [np.asarray(value) for value in jax.jit(jax.vmap(converted))(*map(jnp.asarray, batches))]
    theirs = [function.call([casadi.DM(batch[k]) for batch in batches]) for k in range(points)]
    for index, mine in enumerate(ours):
        expected = np.stack([np.asarray(row[index].full()).reshape(mine.shape[1:]) for row in theirs])
        scale = np.max(np.abs(expected), axis=0, initial=1e-6, where=np.isfinite(expected))
        with np.errstate(invalid="ignore"):  # inf - inf, which the first comparison has settled
            equal = (mine == expected) | (np.abs(mine - expected) <= rtol * scale)
        wrong = np.argwhere(~(equal | (np.isnan(mine) & np.isnan(expected))))
        if len(wrong):
            where = tuple(wrong[0])
            point = ", ".join(f"{function.name_in(i)} = {batch[where[0]].tolist()}" for i, batch in enumerate(batches))
            element = ", ".join(str(int(k)) for k in where[1:])
            raise ConversionError(
                f"{function.name()}: output {function.name_out(index)}[{element}] is {mine[where]!r} in JAX and "
                f"{expected[where]!r} in CasADi, at {point}; refused, since one of the two is wrong. "
                "Write that expression in another way, or report the operation"
            )
    return converted


# The interpreter


class _Step(NamedTuple):
    """One instruction: work slots in and out, and what happens between; inputs and outputs have a position instead."""

    op: int
    reads: tuple[int, ...]
    writes: tuple[int, ...]
    node: Any = None  # MX: the expression; SX: the constant; inputs: how many nonzeros
    argument: int = 0  # inputs and outputs: which one
    offset: int = 0  # and from which nonzero on


def _program(function: casadi.Function, guarded: bool) -> Program:
    match function.class_name():
        case "SXFunction" | "MXFunction":
            return _interpreter(function, guarded)
        case "Map" | "OmpMap" | "ThreadMap":
            return _map(function, guarded)
        case "Switch":
            return _switch(function)
    raise ConversionError(
        f"{function.name()}: a CasADi function of class {function.class_name()} has no JAX counterpart; allowed are SX "
        "and MX functions, map and if_else. Write out what it computes, e.g. a lookup table as a smooth formula; time "
        "integration is done outside the model"
    )


def _steps(function: casadi.Function) -> list[_Step]:
    scalar = function.class_name() == "SXFunction"
    steps = []
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        reads, writes = tuple(function.instruction_input(k)), tuple(function.instruction_output(k))
        if scalar and op == casadi.OP_INPUT:
            steps.append(_Step(op, (), writes, 1, *reads))
        elif scalar and op == casadi.OP_OUTPUT:
            steps.append(_Step(op, reads, (), None, *writes))
        elif scalar:
            steps.append(_Step(op, reads, writes, function.instruction_constant(k) if op == casadi.OP_CONST else None))
        else:
            node = function.instruction_MX(k)
            if op in (casadi.OP_INPUT, casadi.OP_OUTPUT):
                place = node.info()
                size, reads, writes = (node.nnz(), (), writes) if op == casadi.OP_INPUT else (None, reads, ())
                steps.append(_Step(op, reads, writes, size, place["ind"], place["offset"]))
            else:
                steps.append(_Step(op, reads, writes, node))
    return steps


def _feeds_branch(steps: list[_Step]) -> list[bool]:
    """Say of each step whether its result goes, at once or through others, into a branch of a conditional."""
    live: set[int] = set()
    feeds = []
    for step in reversed(steps):
        hit = not live.isdisjoint(step.writes)
        live -= set(step.writes)  # slots are reused: what was there before is another value
        if hit:
            live |= set(step.reads)
        elif step.op == casadi.OP_IF_ELSE_ZERO:
            live.add(step.reads[1])
        feeds.append(hit)
    return feeds[::-1]


def _operation(function: casadi.Function, step: _Step, guarded: bool) -> Program:
    if step.op == casadi.OP_CALL and isinstance(step.node, casadi.MX):
        return _program(step.node.which_function(), guarded)
    program = operation(step.op, step.node, guarded)
    if program is None:
        name = next(name for name in dir(casadi) if name.startswith("OP_") and getattr(casadi, name) == step.op)
        raise ConversionError(
            f"{function.name()}: the CasADi operation {name} has no JAX counterpart; write that expression otherwise"
        )
    return program


def _interpreter(function: casadi.Function, guarded: bool) -> Program:
    steps = _steps(function)
    ends = (casadi.OP_INPUT, casadi.OP_OUTPUT)
    programs = [
        None if step.op in ends else _operation(function, step, guarded or feeds)
        for step, feeds in zip(steps, _feeds_branch(steps), strict=True)
    ]

    def run(arguments: Values, dtype: Any) -> Values:
        work: dict[int, Any] = {}
        results: list[dict[int, Any]] = [{} for _ in range(function.n_out())]
        for step, program in zip(steps, programs, strict=True):
            if program is not None:
                values = program([work[slot] for slot in step.reads], dtype)
                # A comparison of JAX is weakly typed; strict promotion wants one dtype. Python floats stay: literals.
                typed = [value if isinstance(value, float) else jnp.asarray(value, dtype) for value in values]
                work.update(zip(step.writes, typed, strict=True))
            elif step.op == casadi.OP_INPUT:
                work[step.writes[0]] = arguments[step.argument][step.offset : step.offset + step.node]
            else:
                results[step.argument][step.offset] = jnp.atleast_1d(jnp.asarray(work[step.reads[0]], dtype))
        # trailing axes, if any, are points; a constant is the same at all of them
        points = jnp.shape(arguments[0])[1:] if arguments else ()
        empty = jnp.zeros((0, *points), dtype)
        return [
            jnp.concatenate([_at_all(parts[offset], points) for offset in sorted(parts)] or [empty])
            for parts in results
        ]

    return run


def _at_all(value: Array, points: tuple[int, ...]) -> Array:
    return (
        value if value.ndim > 1 or not points else jnp.broadcast_to(value.reshape(1, *(1,) * len(points)), (1, *points))
    )


def _map(function: casadi.Function, guarded: bool) -> Program:
    info = function.info()
    once, count = info["f"], info["n"]
    program = _program(once, guarded)

    def run(arguments: Values, dtype: Any) -> Values:
        rows = [value.reshape(count, once.nnz_in(i)) for i, value in enumerate(arguments)]
        return [value.reshape(-1) for value in jax.vmap(lambda *row: program(list(row), dtype))(*rows)]

    return run


def _switch(function: casadi.Function) -> Program:
    """Return `cases[trunc(index)]`, the default where there is no such case; all of them are evaluated."""
    info = function.info()
    cases = [_projected(case, function) for case in (*info["f"], info["f_def"])]

    def run(arguments: Values, dtype: Any) -> Values:
        index, *operands = arguments
        *chosen, result = [case(operands, dtype) for case in cases]
        for k, values in enumerate(chosen):
            result = [jnp.where(jnp.trunc(index) == k, a, b) for a, b in zip(values, result, strict=True)]
        return result

    return run


def _projected(case: casadi.Function, switch: casadi.Function) -> Program:
    """Fit a case of a switch, always guarded, to the sparsity of the switch."""
    program = _program(case, guarded=True)
    enter = [projection(switch.sparsity_in(i + 1), case.sparsity_in(i)) for i in range(case.n_in())]
    leave = [projection(case.sparsity_out(i), switch.sparsity_out(i)) for i in range(case.n_out())]

    def run(arguments: Values, dtype: Any) -> Values:
        values = program([fit(a) for fit, a in zip(enter, arguments, strict=True)], dtype)
        return [fit(a) for fit, a in zip(leave, values, strict=True)]

    return run


def _shape(sparsity: casadi.Sparsity) -> tuple[int, ...]:
    rows, columns = sparsity.shape
    return (rows * columns,) if columns == 1 or rows * columns == 0 else (rows, columns)


def _arguments(function: casadi.Function, arguments: Sequence[Any]) -> list[Array]:
    names = [function.name_in(i) for i in range(function.n_in())]
    if len(arguments) != len(names):
        raise ValueError(
            f"{function.name()}: {len(arguments)} argument(s) given, expected {len(names)}: {', '.join(names)}"
        )
    arrays = [jnp.asarray(argument) for argument in arguments]
    for i, (name, array) in enumerate(zip(names, arrays, strict=True)):
        expected = _shape(function.sparsity_in(i))
        if array.shape != expected:
            raise ValueError(
                f"{function.name()}: argument {name} has shape {array.shape}, expected {expected}; the function is of "
                "one point, use jax.vmap for many"
            )
    return arrays


def _dtype(function: casadi.Function, arrays: list[Array]) -> Any:
    dtypes = {array.dtype for array in arrays if array.size} or {jnp.zeros(()).dtype}
    if len(dtypes) > 1 or not jnp.issubdtype(next(iter(dtypes)), jnp.floating):
        given = ", ".join(f"{function.name_in(i)} {array.dtype}" for i, array in enumerate(arrays))
        raise TypeError(f"{function.name()}: the arguments need one floating dtype, got {given}; cast them with astype")
    return next(iter(dtypes))
