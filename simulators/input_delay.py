"""Inputs as they arrive in the last of several held rows: delayed and lagged, as means over the substeps, in symbols."""

from collections.abc import Sequence

import casadi

from simulators.expression import Symbol
from simulators.model import Model


def delayed_inputs(model: Model, u: Symbol, p: Symbol) -> list[Symbol]:
    """Return the inputs (du, 1) of every substep of the last row.

    Args:
        model: says how late and how slowly inputs act.
        u: inputs of `model.past()` rows and the last one, oldest first, in one column.
        p: uncertain parameters, which a delay or a lag may be.

    The mean of a held input over a substep that lies d in the past is a sum over rows, each weighted with the share of the
    substep that it fills; a lag follows that staircase exactly, settled at its first value.

    """
    du, past = len(model.inputs), model.past()
    rows = [u[du * r : du * (r + 1)] for r in range(past + 1)]
    if not (model.delay or model.lag):
        return [rows[-1]] * model.substeps
    names = [q.name for q in model.params]

    def seconds(value: float | str) -> Symbol:
        if not isinstance(value, str):
            return value
        return p[names.index(value)] if value in names else model.fixed[value]

    each = [
        _one(
            [row[i] for row in rows],
            seconds(model.delay.get(q.name, 0.0)) / model.dt,
            seconds(model.lag[q.name]) if q.name in model.lag else None,
            model,
        )
        for i, q in enumerate(model.inputs)
    ]
    return [casadi.vertcat(*(values[s] for values in each)) for s in range(model.substeps)]


def _one(rows: Sequence[Symbol], late: Symbol, lag: Symbol | None, model: Model) -> list[Symbol]:
    """Return one input at every substep of the last row; `late` in rows."""
    past, n = len(rows) - 1, model.substeps

    def passed(k: int, j: int) -> Symbol:
        return casadi.fmin(casadi.fmax(past - j + k / n - late, 0.0), 1.0)

    shares = [[n * (passed(s + 1, j) - passed(s, j)) for j in range(past + 1)] for s in range(n)]
    for share in shares:  # later than all that is known: the oldest
        share[0] = share[0] + 1 - sum(share)

    def mean(r: int, s: int) -> Symbol:
        return sum(share * rows[max(0, r - past + j)] for j, share in enumerate(shares[s]))

    if lag is None:
        return [mean(past, s) for s in range(n)]
    ratio = model.dt / n / (lag + 1e-15 * model.dt / n)
    keep = casadi.exp(-ratio)
    means = [mean(r, s) for r in range(past + 1) for s in range(n)]
    end, found = means[0], []
    for value in means:
        found.append(value + (end - value) * (1 - keep) / ratio)
        end = keep * end + (1 - keep) * value
    return found[-n:]
