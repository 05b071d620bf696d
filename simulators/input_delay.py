"""Inputs as they arrive in one row: held or linear between rows, delayed and lagged, over the substeps, in symbols."""

from collections.abc import Sequence
from typing import NamedTuple

import casadi

from simulators.expression import Symbol
from simulators.model import Model


class Arriving(NamedTuple):
    """The inputs over one substep: a straight line with the same mean and the same first moment.

    Args:
        mean: (du, 1).
        rise: from the beginning to the end, (du, 1); None: no input is linear, and what is held does not rise.

    """

    mean: Symbol
    rise: Symbol | None

    def at(self, share: float) -> Symbol:
        """Return the inputs after a share of the substep, (du, 1)."""
        return self.mean if self.rise is None else self.mean + (share - 0.5) * self.rise


def delayed_inputs(model: Model, u: Symbol, p: Symbol) -> list[Arriving]:
    """Return the inputs over every substep of the last row.

    Args:
        model: says how late and how slowly inputs act, and which are linear between rows.
        u: inputs of `model.past()` rows and the last one, oldest first, then the next values of the linear ones
            (`model.linear`), in one column.
        p: uncertain parameters, which a delay or a lag may be.

    The mean over a substep that lies d in the past is a sum over rows: of a held input each is weighted with the share of the
    substep that it fills, of a linear one with the integral of its hat function, and the first moment likewise. A lag follows
    that exactly, settled at its first value.

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

    each = []
    for i, q in enumerate(model.inputs):
        late = seconds(model.delay.get(q.name, 0.0)) / model.dt
        values = [row[i] for row in rows]
        line = _linear([*values, following[i]], late, model) if i in following else _held(values, late, model)
        each.append(_lagged(line, seconds(model.lag[q.name]), model) if q.name in model.lag else line)
    last = [line[-model.substeps :] for line in each]
    return [
        Arriving(
            casadi.vertcat(*(line[s][0] for line in last)), casadi.vertcat(*(line[s][1] for line in last)) if linear else None
        )
        for s in range(model.substeps)
    ]  # fmt: skip


Line = list[tuple[Symbol, Symbol]]  # mean and rise of one input at every substep of all rows


def _held(rows: Sequence[Symbol], late: Symbol, model: Model) -> Line:
    """Return a held input; `late` in rows. What it rises within a substep in which it jumps is left out."""
    past, n = len(rows) - 1, model.substeps

    def passed(k: int, j: int) -> Symbol:
        return casadi.fmin(casadi.fmax(past - j + k / n - late, 0.0), 1.0)

    shares = [[n * (passed(s + 1, j) - passed(s, j)) for j in range(past + 1)] for s in range(n)]
    for share in shares:  # later than all that is known: the oldest
        share[0] = share[0] + 1 - sum(share)

    def mean(r: int, s: int) -> Symbol:
        return sum(share * rows[max(0, r - past + j)] for j, share in enumerate(shares[s]))

    return [(mean(r, s), 0.0) for r in range(past + 1) for s in range(n)]


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
    weights = [[_hat(past - j + s / n - late, 1 / n) for j in range(past + 2)] for s in range(n)]
    for one in weights:
        one[0] = (one[0][0] + 1 - sum(mean for mean, _ in one), one[0][1] - sum(rise for _, rise in one))

    def line(r: int, s: int) -> tuple[Symbol, Symbol]:
        near = [rows[max(0, r - past + j)] for j in range(past + 2)]
        mean, rise = (sum(w[k] * v for w, v in zip(weights[s], near, strict=True)) for k in (0, 1))
        return mean, rise

    return [line(r, s) for r in range(past + 1) for s in range(n)]


def _hat(begin: Symbol, length: float) -> tuple[Symbol, Symbol]:
    """Return mean and rise, over [begin, begin + length], of the hat function about 0; the rise keeps the first moment."""
    end = begin + length

    def clipped(t: Symbol, low: float) -> Symbol:
        return casadi.fmin(casadi.fmax(t - low, 0.0), 1.0)

    def area(t: Symbol) -> Symbol:
        up, down = clipped(t, -1.0), clipped(t, 0.0)
        return up**2 / 2 + down - down**2 / 2

    def twice(t: Symbol) -> Symbol:
        """Integral of the area."""
        up, down = clipped(t, -1.0), clipped(t, 0.0)
        return up**3 / 6 + down / 2 + down**2 / 2 - down**3 / 6 + casadi.fmax(t - 1.0, 0.0)

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
