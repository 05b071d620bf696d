"""Inputs as they arrive in one row: held or linear between rows, delayed and lagged, over the substeps, in symbols."""

from collections.abc import Sequence
from typing import NamedTuple

import casadi

from simulators.expression import Symbol
from simulators.model import Model
from simulators.overshoot import reach

HAIR = 1e-15  # of the range of an input


class Arriving(NamedTuple):
    """The inputs over one substep: a straight line with the same mean and the same first moment.

    Args:
        mean: (du, 1).
        rise: from the beginning to the end, (du, 1); None: no input is linear or late, and what is held does not rise.
        linear: rows of the inputs that are linear between rows.

    """

    mean: Symbol
    rise: Symbol | None
    linear: tuple[int, ...] = ()

    def at(self, share: float) -> Symbol:
        """Return the inputs after a share of the substep, (du, 1)."""
        return self.mean if self.rise is None else self.mean + (share - 0.5) * self.rise

    def read(self) -> Symbol:
        """Return the inputs that what is read at the beginning goes by, (du, 1): of what is held the mean."""
        if self.rise is None:
            return self.mean
        begin = self.at(0.0)
        return casadi.vertcat(*((begin if i in self.linear else self.mean)[i] for i in range(self.mean.shape[0])))


def delayed_inputs(model: Model, u: Symbol, p: Symbol) -> list[Arriving]:
    """Return the inputs over every substep of the last row.

    Args:
        model: says how late and how slowly inputs act, and which are linear between rows.
        u: inputs of `model.past()` rows and the last one, oldest first, then the next values of the linear ones
            (`model.linear`), in one column.
        p: uncertain parameters, which a delay or a lag may be.

    The mean over a substep that lies d in the past is a sum over rows: of a held input each is weighted with the share of the
    substep that it fills, of a linear one with the integral of its hat function, and the first moment likewise, which says when
    in a substep a held one arrives. A lag follows that exactly, settled at its first value.

    """
    du, past, linear = len(model.inputs), model.past(), model.linear
    rows = [u[du * r : du * (r + 1)] for r in range(past + 1)]
    following = {i: u[du * (past + 1) + k] for k, i in enumerate(linear)}
    if not (model.delay or model.lag or linear):
        return [Arriving(rows[-1], None)] * model.substeps
    names = [q.name for q in model.params]

    def seconds(value: float | str) -> Symbol:
        if not isinstance(value, str):
            return value
        return p[names.index(value)] if value in names else model.fixed[value]

    each, ranges = [], reach(model)
    for i, q in enumerate(model.inputs):
        late = seconds(model.delay.get(q.name, 0.0)) / model.dt
        values = [row[i] for row in rows]
        line = _linear([*values, following[i]], late, model) if i in following else _held(values, late, model)
        line = (_lagged(line, seconds(model.lag[q.name]), model) if q.name in model.lag else line)[-model.substeps :]
        late_one = q.name in model.delay or q.name in model.lag
        each.append(_within(line, ranges[i], values) if late_one and i not in following else line)
    return [
        Arriving(casadi.vertcat(*(line[s][0] for line in each)), casadi.vertcat(*(line[s][1] for line in each)), linear)
        for s in range(model.substeps)
    ]  # fmt: skip


Line = list[tuple[Symbol, Symbol]]  # mean and rise of one input at every substep of all rows


def _held(rows: Sequence[Symbol], late: Symbol, model: Model) -> Line:
    """Return a held input; `late` in rows."""
    past, n = len(rows) - 1, model.substeps
    if isinstance(late, float) and late == 0.0:
        return [(rows[r], 0.0) for r in range(past + 1) for _ in range(n)]
    return _weighed(rows, [[_box(past - j + s / n - late, 1 / n) for j in range(past + 1)] for s in range(n)], past)


def _within(line: Line, ends: tuple[Symbol, Symbol], given: Sequence[Symbol]) -> Line:
    """Return a line that keeps to the range of its input (`reach`), or to what was given beyond that; its mean stays.

    A hair within: not even what is rounded is beyond it.
    """
    low, high = ends
    for value in given:
        low, high = casadi.fmin(low, value), casadi.fmax(high, value)
    hair = HAIR * (high - low)
    found = []
    for mean, rise in line:
        within = casadi.fmin(casadi.fmax(mean, low + hair), high - hair)
        most = 2 * casadi.fmin(within - low, high - within) * (1 - HAIR)
        found.append((within, casadi.fmin(casadi.fmax(rise, -most), most)))
    return found


def _linear(rows: Sequence[Symbol], late: Symbol, model: Model) -> Line:
    """Return an input that is linear between rows; the last of `rows` is the one after the row in question."""
    past, n = len(rows) - 2, model.substeps
    if isinstance(late, float) and late == 0.0:
        return [
            (rows[r] + (s + 0.5) / n * (rows[r + 1] - rows[r]), (rows[r + 1] - rows[r]) / n)
            for r in range(past + 1)
            for s in range(n)
        ]
    # of the row in question, those before it and the one after it; before the first row the input stood still
    return _weighed(rows, [[_hat(past - j + s / n - late, 1 / n) for j in range(past + 2)] for s in range(n)], past)


def _weighed(rows: Sequence[Symbol], weights: list[list[tuple[Symbol, Symbol]]], past: int) -> Line:
    """Return the line of every substep of all rows; weights: of the rows near one, in each of its substeps."""
    for one in weights:  # later than all that is known: the oldest
        one[0] = (one[0][0] + 1 - sum(mean for mean, _ in one), one[0][1] - sum(rise for _, rise in one))

    def line(r: int, share: list[tuple[Symbol, Symbol]]) -> tuple[Symbol, Symbol]:
        near = [rows[max(0, r - past + j)] for j in range(len(share))]
        mean, rise = (sum(w[k] * v for w, v in zip(share, near, strict=True)) for k in (0, 1))
        return mean, rise

    return [line(r, share) for r in range(past + 1) for share in weights]


def _clipped(t: Symbol, low: float) -> Symbol:
    return casadi.fmin(casadi.fmax(t - low, 0.0), 1.0)


def _box(begin: Symbol, length: float) -> tuple[Symbol, Symbol]:
    """Return mean and rise, over [begin, begin + length], of the box that begins at 0, one row long: it fills an end of it."""
    share = (_clipped(begin + length, 0.0) - _clipped(begin, 0.0)) / length
    return share, 6 * share * (1 - share) * casadi.if_else(begin <= 0, 1.0, -1.0)


def _hat(begin: Symbol, length: float) -> tuple[Symbol, Symbol]:
    """Return mean and rise, over [begin, begin + length], of the hat function about 0; the rise keeps the first moment."""

    def area(t: Symbol) -> Symbol:
        up, down = _clipped(t, -1.0), _clipped(t, 0.0)
        return up**2 / 2 + down - down**2 / 2

    def twice(t: Symbol) -> Symbol:
        """Integral of the area."""
        up, down = _clipped(t, -1.0), _clipped(t, 0.0)
        return up**3 / 6 + down / 2 + down**2 / 2 - down**3 / 6 + casadi.fmax(t - 1.0, 0.0)

    end = begin + length
    moment = length / 2 * (area(end) + area(begin)) - (twice(end) - twice(begin))
    return (area(end) - area(begin)) / length, 12 * moment / length**2


def _lagged(line: Line, lag: Symbol, model: Model) -> Line:
    """Return what a first-order lag makes of an input; the answer to a straight line is exact, then a line again."""
    h = model.dt / model.substeps
    ratio = h / (lag + 1e-15 * h)
    keep = casadi.exp(-ratio)
    begin, found = line[0][0] - line[0][1] / 2, []
    for mean, rise in line:
        settled = mean - rise / 2 - rise / ratio  # the particular solution at the beginning
        end = settled + rise + keep * (begin - settled)
        fading = begin - settled
        turn = 12 * ((1 - keep) / ratio**2 - (1 + keep) / (2 * ratio))  # rise of exp(-t/tau), by its first moment
        found.append((mean - rise / ratio + fading * (1 - keep) / ratio, rise + fading * turn))
        begin = end
    return found
