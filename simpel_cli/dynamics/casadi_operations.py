"""What each CasADi operation computes, in JAX, on vectors of structural nonzeros (column by column).

Reverse mode sends a zero cotangent into the branch of a conditional that was not taken, where it meets the infinite
slope of sqrt or 1/x at 0, and 0 * inf = nan. `guarded` operations stop it. Values are never touched. The price: where
CasADi's derivative is infinite or nan, a guarded one may be zero.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, TypeAlias, cast

import casadi
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

Values: TypeAlias = list[Any]  # each an Array of nonzeros, or a Python float (a constant of an SX function)
Program: TypeAlias = Callable[[Values, Any], Values]  # (nonzeros of the operands, dtype) -> nonzeros of the results


def operation(op: int, node: Any, guarded: bool) -> Program | None:
    """Return the program of one instruction, None where there is no JAX counterpart.

    Args:
        op: CasADi's number of the operation.
        node: the MX expression; for an SX constant its value, for other SX instructions None.
        guarded: stop cotangents at infinite slopes. Roots and powers always do: a tank is written `sqrt(max(h, 0))`.

    """
    if op in _ELEMENTWISE:
        careful = op in _ROOTS or (guarded and op not in _LINEAR)
        apply = _guarded(_ELEMENTWISE[op]) if careful else _ELEMENTWISE[op]
        return lambda values, dtype: [apply(*values)]
    if op == casadi.OP_CONST:
        if isinstance(node, float):
            return lambda values, dtype: [node]
        constant = np.array(node.to_DM().nonzeros(), dtype=np.float64)
        return lambda values, dtype: [jnp.asarray(constant, dtype)]
    if node is None:
        return None
    return _matrix(_MATRIX[op], node, guarded) if op in _MATRIX else _move(op, node)


# Elementwise operations, in both kinds of function


def _truth(condition: Array) -> Array:
    return jnp.where(condition, 1.0, 0.0)


def _remainder(a: Any, b: Any) -> Array:
    return jnp.subtract(a, b * jnp.round(jnp.divide(a, b)))  # IEEE 754: to the nearest multiple, ties to even


# fmt: off
_ELEMENTWISE: dict[int, Callable[..., Array]] = {
    casadi.OP_ASSIGN: jnp.asarray, casadi.OP_ADD: jnp.add, casadi.OP_SUB: jnp.subtract,
    casadi.OP_MUL: jnp.multiply, casadi.OP_DIV: jnp.divide, casadi.OP_NEG: jnp.negative, casadi.OP_EXP: jnp.exp,
    casadi.OP_LOG: jnp.log, casadi.OP_POW: jnp.power, casadi.OP_CONSTPOW: jnp.power, casadi.OP_SQRT: jnp.sqrt,
    casadi.OP_SQ: jnp.square, casadi.OP_TWICE: lambda a: jnp.multiply(2.0, a), casadi.OP_SIN: jnp.sin,
    casadi.OP_COS: jnp.cos, casadi.OP_TAN: jnp.tan, casadi.OP_ASIN: jnp.arcsin, casadi.OP_ACOS: jnp.arccos,
    casadi.OP_ATAN: jnp.arctan, casadi.OP_LT: lambda a, b: _truth(jnp.less(a, b)),
    casadi.OP_LE: lambda a, b: _truth(jnp.less_equal(a, b)), casadi.OP_EQ: lambda a, b: _truth(jnp.equal(a, b)),
    casadi.OP_NE: lambda a, b: _truth(jnp.not_equal(a, b)), casadi.OP_NOT: lambda a: _truth(jnp.equal(a, 0.0)),
    casadi.OP_AND: lambda a, b: _truth(jnp.not_equal(a, 0.0) & jnp.not_equal(b, 0.0)),
    casadi.OP_OR: lambda a, b: _truth(jnp.not_equal(a, 0.0) | jnp.not_equal(b, 0.0)),
    casadi.OP_FLOOR: jnp.floor, casadi.OP_CEIL: jnp.ceil, casadi.OP_FMOD: jnp.fmod, casadi.OP_FABS: jnp.abs,
    casadi.OP_SIGN: jnp.sign, casadi.OP_COPYSIGN: jnp.copysign,
    casadi.OP_IF_ELSE_ZERO: lambda c, a: jnp.where(jnp.not_equal(c, 0.0), a, 0.0),
    casadi.OP_ERF: lambda a: jax.lax.erf(jnp.asarray(a)),
    casadi.OP_ERFINV: lambda a: jax.lax.erf_inv(jnp.asarray(a)), casadi.OP_INV: jnp.reciprocal,
    casadi.OP_SINH: jnp.sinh, casadi.OP_COSH: jnp.cosh, casadi.OP_TANH: jnp.tanh, casadi.OP_ASINH: jnp.arcsinh,
    casadi.OP_ACOSH: jnp.arccosh, casadi.OP_ATANH: jnp.arctanh, casadi.OP_ATAN2: jnp.arctan2,
    casadi.OP_LOG1P: jnp.log1p, casadi.OP_EXPM1: jnp.expm1, casadi.OP_HYPOT: jnp.hypot,
    casadi.OP_REMAINDER: _remainder, casadi.OP_LIFT: lambda a, _: a,
    # nan wins, where C's fmin and fmax drop it: a nan is to be noticed
    casadi.OP_FMIN: jnp.minimum, casadi.OP_FMAX: jnp.maximum,
}
# fmt: on
_ROOTS = {casadi.OP_SQRT, casadi.OP_POW, casadi.OP_CONSTPOW}
_LINEAR = {casadi.OP_ASSIGN, casadi.OP_ADD, casadi.OP_SUB, casadi.OP_NEG, casadi.OP_TWICE, casadi.OP_IF_ELSE_ZERO}


def _guarded(operation: Callable[..., Array]) -> Callable[..., Array]:
    """Stop the cotangent of each operand, element by element, where the slope is not finite; the value stays.

    This makes first derivatives safe. Second ones may still meet an infinite curvature, as of x**1.5 at 0.
    """

    def careful(*operands: Any) -> Array:
        held = [jax.lax.stop_gradient(operand) for operand in operands]

        def along(i: int) -> Any:
            if not isinstance(operands[i], Array):
                return operands[i]
            _, slope = jax.jvp(lambda a: operation(*held[:i], a, *held[i + 1 :]), (held[i],), (jnp.ones_like(held[i]),))
            return jnp.where(jnp.isfinite(slope), operands[i], held[i])

        return operation(*(along(i) for i in range(len(operands))))

    return careful


# Matrix operations, on dense 2-D operands


def _solve(node: casadi.MX, b: Array, a: Array) -> Array:
    return cast(Array, jnp.linalg.solve(a.T if node.info()["tr"] else a, b))


def _norm_fro(_: casadi.MX, a: Array) -> Array:
    total = jnp.sum(a * a)
    return jnp.where(total > 0, jnp.sqrt(jnp.where(total > 0, total, 1.0)), 0.0)  # slope 0, not nan, at the origin


_MATRIX: dict[int, Callable[..., Array]] = {
    casadi.OP_TRANSPOSE: lambda _, a: a.T,
    casadi.OP_MTIMES: lambda _, c, a, b: c + a @ b,
    casadi.OP_SOLVE: _solve,
    casadi.OP_DETERMINANT: lambda _, a: jnp.linalg.det(a),
    casadi.OP_DOT: lambda _, a, b: jnp.sum(a * b),
    casadi.OP_BILIN: lambda _, a, x, y: x.T @ a @ y,
    casadi.OP_RANK1: lambda _, a, alpha, x, y: a + alpha * (x @ y.T),
    casadi.OP_KRON: lambda _, a, b: jnp.kron(a, b),
    casadi.OP_NORM1: lambda _, a: jnp.sum(jnp.abs(a)),
    casadi.OP_NORMINF: lambda _, a: jnp.max(jnp.abs(a)),
    casadi.OP_NORMF: _norm_fro,
    casadi.OP_MMIN: lambda _, a: jnp.min(a),
    casadi.OP_MMAX: lambda _, a: jnp.max(a),
    casadi.OP_LOGSUMEXP: lambda _, a: jax.nn.logsumexp(a),
}


def _matrix(operation: Callable[..., Array], node: casadi.MX, guarded: bool) -> Program:
    operands = [node.dep(i).sparsity() for i in range(node.n_dep())]

    def run(values: Values, dtype: Any) -> Values:
        dense = [to_dense(value, sparsity) for value, sparsity in zip(values, operands, strict=True)]
        if guarded:  # as for elementwise operations, but the operands as one: their partials are not worth forming
            held = [jax.lax.stop_gradient(value) for value in dense]
            finite = [jnp.all(jnp.isfinite(value)) for value in (*held, operation(node, *held))]
            fine = jnp.all(jnp.stack(finite))
            dense = [jnp.where(fine, value, still) for value, still in zip(dense, held, strict=True)]
        return [to_nonzeros(operation(node, *dense).reshape(node.shape), node.sparsity())]

    return run


# Operations that only move nonzeros


def _take(indices: np.ndarray) -> Callable[[Array], Array]:
    """Return `a -> a[indices]`, where index -1 stands for a zero."""
    if len(indices) and indices[0] >= 0 and np.all(np.diff(indices) == 1):
        return lambda a: a[int(indices[0]) : int(indices[-1]) + 1]  # a slice fuses, a gather does not
    if np.any(indices < 0):
        return lambda a: jnp.concatenate([a, jnp.zeros(1, a.dtype)])[indices]
    return lambda a: a[indices]


def projection(old: casadi.Sparsity, new: casadi.Sparsity) -> Callable[[Array], Array]:
    """Return the map of nonzeros from one pattern to another of the same shape; what is new there is zero."""
    place = {linear: k for k, linear in enumerate(old.find())}
    return _take(np.array([place.get(linear, -1) for linear in new.find()], dtype=int))


def _move(op: int, node: casadi.MX) -> Program | None:
    match op:
        case casadi.OP_RESHAPE | casadi.OP_SPARSITY_CAST:
            return lambda values, dtype: values
        case casadi.OP_HORZCAT | casadi.OP_VERTCAT | casadi.OP_DIAGCAT:
            return lambda values, dtype: [jnp.concatenate(values)]
        case casadi.OP_HORZSPLIT | casadi.OP_VERTSPLIT | casadi.OP_DIAGSPLIT:
            offset = node.info()["offset"]
            return lambda values, dtype: [values[0][start:stop] for start, stop in pairwise(offset)]
        case casadi.OP_HORZREPMAT:
            return lambda values, dtype: [jnp.tile(values[0], node.size2() // node.dep(0).size2())]
        case casadi.OP_HORZREPSUM:
            return lambda values, dtype: [values[0].reshape(-1, node.nnz()).sum(axis=0)]
        case casadi.OP_PROJECT:
            project = projection(node.dep(0).sparsity(), node.sparsity())
            return lambda values, dtype: [project(values[0])]
        case casadi.OP_GETNONZEROS:
            take = _take(_mapping(node))
            return lambda values, dtype: [take(values[0])]
        case casadi.OP_SETNONZEROS | casadi.OP_ADDNONZEROS:
            target = _mapping(node)
            kept = np.flatnonzero(target >= 0)  # CasADi marks with -1 what a later value overwrites
            if op == casadi.OP_SETNONZEROS:
                return lambda values, dtype: [values[0].at[target[kept]].set(values[1][kept])]
            return lambda values, dtype: [values[0].at[target[kept]].add(values[1][kept])]
    return None


def _mapping(node: casadi.MX) -> np.ndarray:
    return np.array(node.mapping().nonzeros(), dtype=int)


# Between dense arrays and nonzeros


def to_nonzeros(array: Array, sparsity: casadi.Sparsity) -> Array:
    """Return the structural nonzeros of a dense column or matrix, column by column."""
    column = array.T.reshape(-1)
    return column if sparsity.is_dense() else column[np.array(sparsity.find(), dtype=int)]


def to_dense(nonzeros: Array, sparsity: casadi.Sparsity) -> Array:
    """Return the dense 2-D matrix of a vector of nonzeros."""
    rows, columns = sparsity.shape
    if not sparsity.is_dense():
        everything = jnp.zeros(rows * columns, nonzeros.dtype)
        nonzeros = everything.at[np.array(sparsity.find(), dtype=int)].set(nonzeros)
    return nonzeros.reshape(columns, rows).T
