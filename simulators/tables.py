"""Tables of one or two inputs as expressions: linear, or the cubic spline that CasADi's `interpolant` makes of them.

A spline is a sum of polynomials, one for each interval between two knots, in how much of that interval lies below the
argument: t = 0 before it, 1 behind it. What a polynomial has grown to at t = 1 stays, so nothing has to choose an
interval, the end values are held outside the axes, and the terms do not cancel (single precision is enough).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import casadi
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from simulators.definitions import Definition
from simulators.expression import Symbol
from simulators.quantity import ModelError, check_keys, check_word, read_number, read_unit, refuse_unknown
from simulators.table_files import READ_FROM, with_file_read

DEGREES = {"linear": 1, "cubic": 3}
KEYS = ("unit", "inputs", "method", "file", "axes", "values", READ_FROM)


class Axis(NamedTuple):
    """The B-splines of an axis.

    Args:
        nodes: of the table.
        knots: of the splines.
        degree: of the splines.
    """

    nodes: np.ndarray
    knots: np.ndarray
    degree: int

    def coefficients(self, values: np.ndarray) -> np.ndarray:
        """Return the weights (n, ...) of the splines that pass through values (n, ...) at the nodes."""
        return np.asarray(make_interp_spline(self.nodes, values, self.degree, self.knots).c)

    def sums(self, weights: np.ndarray, x: Symbol) -> list[Symbol]:
        """Return the sums of splines at x, one for each column of weights (n, sums)."""
        breaks = np.unique(self.knots)
        spline = BSpline(self.knots, weights, self.degree)
        widths = np.diff(breaks)
        # of the polynomial of each interval in t; the knots are right-continuous, so these are those of the interval behind
        powers = [
            spline(breaks[:-1], nu=p) * widths[:, None] ** p / math.factorial(p) for p in range(1, self.degree + 1)
        ]
        parts = [
            casadi.fmin(casadi.fmax((x - float(a)) / float(d), 0), 1) for a, d in zip(breaks, widths, strict=False)
        ]
        found = []
        for column, first in enumerate(spline(breaks[0])):
            total = type(x)(float(first))
            for k, t in enumerate(parts):
                terms = [float(power[k, column]) for power in powers]
                if any(terms):
                    total += _polynomial(terms, t)
            found.append(total)
        return found


def axis_of(nodes: Sequence[float], degree: int) -> Axis:
    """Return the splines of an axis, with the knots of "not a knot" where they are cubic."""
    x = np.asarray(nodes, np.float64)
    inner = (degree - 1) // 2  # nodes beside each end that are no knots
    between = x[1 + inner : len(x) - 1 - inner]
    return Axis(x, np.concatenate([[x[0]] * (degree + 1), between, [x[-1]] * (degree + 1)]), degree)


def table(axes: Sequence[Sequence[float]], values: Any, method: str, points: Sequence[Symbol]) -> Symbol:
    """Return the value of a table as an expression.

    Args:
        axes: increasing nodes of each input.
        values: at the nodes, (n,) or (n, m).
        method: linear or cubic.
        points: one term for each input.
    """
    splines = [axis_of(nodes, DEGREES[method]) for nodes in axes]
    weights = splines[0].coefficients(np.asarray(values, np.float64))
    if len(splines) == 1:
        return splines[0].sums(weights[:, None], points[0])[0]
    weights = splines[1].coefficients(weights.T).T
    rows, columns = (s.sums(np.eye(len(s.nodes)), point) for s, point in zip(splines, points, strict=True))
    total = 0
    for row, own in zip(rows, weights, strict=True):
        total += row * _sum(w * column for w, column in zip(own.tolist(), columns, strict=True) if w)
    return total


def read_tables(nodes: Mapping[str, Any], known: Iterable[str]) -> dict[str, Definition]:
    """Read `tables`.

    Args:
        nodes: by name.
        known: names that can be inputs of a table.

    Raises:
        ModelError: names the key, what it holds, what is allowed and the cure.
    """
    names = list(known)
    return {name: _read(f"sim.tables.{name}", node, names) for name, node in nodes.items()}


def _read(path: str, node: Any, known: list[str]) -> Definition:
    check_keys(path, node, KEYS)
    read_unit(path, node)
    inputs = node.get("inputs")
    if not isinstance(inputs, list | tuple) or len(inputs) not in (1, 2) or len(set(map(str, inputs))) < len(inputs):
        raise ModelError(
            f"{path}.inputs: {inputs!r} is not allowed; write one or two names, e.g. inputs: [rpm, throttle]"
        )
    for name in inputs:
        if name not in known:
            what = "is no state, input, parameter, intermediate or table"
            refuse_unknown(f"{path}.inputs", f"{name!r} {what}", str(name), known)
    method = node.get("method", "linear")
    check_word(f"{path}.method", method, tuple(DEGREES))
    node = with_file_read(path, node, [Path.cwd()])
    for key in ("axes", "values"):
        if key not in node:
            raise ModelError(f"{path}: no {key}; give `file: <CSV>`, or `axes: [[...]]` and `values: [...]`")
    axes = _axes(path, node["axes"], inputs, method)
    values = _values(f"{path}.values", node["values"], [len(axis) for axis in axes])
    return Definition(
        path, frozenset(inputs), lambda scope: table(axes, values, method, [scope[name] for name in inputs])
    )


def _axes(path: str, given: Any, inputs: Sequence[str], method: str) -> list[list[float]]:
    if not _is_list(given) or len(given) != len(inputs) or not all(_is_list(nodes) for nodes in given):
        raise ModelError(
            f"{path}.axes: {given!r} is not allowed; write a list of nodes for each of {', '.join(inputs)}: "
            "axes: [[0, 1, 2]] for one input, axes: [[0, 1, 2], [0, 5]] for two"
        )
    axes = []
    for name, nodes in zip(inputs, given, strict=True):
        axis = [read_number(f"{path}.axes", node) for node in nodes]
        least = DEGREES[method] + 1
        if len(axis) < least:
            cure = "add nodes, or write method: linear" if method == "cubic" else "add nodes"
            raise ModelError(f"{path}.axes: {len(axis)} node(s) of {name}; {method} needs at least {least}; {cure}")
        for i, (a, b) in enumerate(pairwise(axis)):
            if b <= a:
                raise ModelError(
                    f"{path}.axes: {name} is not increasing: {a:g} then {b:g} (nodes {i + 1} and {i + 2}); sort the nodes, "
                    "each once"
                )
        axes.append(axis)
    return axes


def _values(path: str, given: Any, sizes: list[int]) -> list[Any]:
    size, *inner = sizes
    if not _is_list(given) or len(given) != size:
        shape = " lists of ".join(map(str, sizes))
        count = f"{len(given)} entries" if _is_list(given) else repr(given)
        raise ModelError(f"{path}: {count}; the axes ask for {shape} numbers; give one value for each node")
    if not inner:
        return [read_number(path, value) for value in given]
    return [_values(path, row, inner) for row in given]


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple)


def _polynomial(coefficients: Sequence[float], t: Symbol) -> Symbol:
    """Return c1 t + c2 t^2 + ..., by Horner's rule."""
    total = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = coefficient + t * total
    return t * total


def _sum(terms: Iterable[Symbol]) -> Symbol:
    total = 0
    for term in terms:
        total = total + term
    return total
