"""What a force would do to the innovations of a filter that does not know of it, to first order along its track.

    d[k+1] = F[k] d+[k] + dt/2 (F[k] a[k] + a'[k]),    d+[k] = (I - K[k] H[k]) d[k],    de[k] = -H[k] d[k]

a[k] is the force at the filtered state of row k, a'[k] at the one predicted from it, both with the input of row k. So
any number of forces is tried on one run of the filter, and no program is compiled for them. What they do to the gains K, by
way of the slopes F, is left out.

Reference: Jazwinski (1970), Stochastic processes and filtering theory, ch. 8 (the filter's equations, linearised).
"""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import casadi
import numpy as np

from simpel_cli.filtering.likelihood.augmented import Augmented
from simpel_cli.filtering.likelihood.track import Track
from simulators.effects import Term

Forces: TypeAlias = Mapping[int, tuple[np.ndarray, np.ndarray]]  # row of the state -> at filtered, at predicted states


def shifts(
    track: Track, ok: np.ndarray, forces: Forces, dt: float, reading: np.ndarray | None = None
) -> np.ndarray:  # fmt: skip
    """Return the change of every innovation per unit of each force, (W, T, ny, n); 0 where nothing was measured.

    Args:
        track: of the filter, (W, T, ...) each.
        ok: (W, T, ny) whether it was measured.
        forces: what each adds to these rates, per second: (W, T, n) at the filtered states, and at those predicted from them.
        dt: s.
        reading: (W, T, ny, n) what is added to what sensors read; None: nothing.
    """
    count, rows, nx = track.mean.shape
    n = next(iter(forces.values()))[0].shape[-1] if reading is None else reading.shape[-1]
    d = np.zeros((count, nx, n))
    found = np.zeros((*ok.shape, n))
    for k in range(rows):
        cov = np.array(track.predicted_cov[:, k])
        for j in range(ok.shape[2]):
            h = track.slope[:, k, j]
            measured = ok[:, k, j, None] > 0
            shown = np.einsum("wi,win->wn", h, d) + (0.0 if reading is None else reading[:, k, j])
            change = np.where(measured, -shown, 0.0)
            found[:, k, j] = change
            gain = np.einsum("wij,wj->wi", cov, h)
            pull = np.where(measured, gain / track.variance[:, k, j, None], 0.0)
            d = d + pull[:, :, None] * change[:, None]
            cov = cov - pull[:, :, None] * gain[:, None]
        f = track.jacobian[:, k]
        d = np.einsum("wij,wjn->win", f, d)
        for row, (here, there) in forces.items():
            d += dt / 2 * f[:, :, row, None] * here[:, k, None]
            d[:, row] += dt / 2 * there[:, k]
    return found


def waves(
    augmented: Augmented, terms: Sequence[Term], p: np.ndarray, points: Sequence[tuple[np.ndarray, np.ndarray]],
    rows: Sequence[int],
) -> Forces:  # fmt: skip
    """Return what each weight of functions adds to rates, per standard deviation of its prior, (..., n) per row and point.

    Args:
        augmented: a model that has the terms.
        terms: functions without a name: linear in their parameters, which have normal priors.
        p: (dp,) values of all parameters.
        points: two, states (..., nx) and inputs (..., nu): filtered, and predicted from them.
        rows: of the state, whose rates are asked.
    """
    function = augmented.function
    x, u, q = (augmented.model.symbol.sym(n, function.size1_in(i)) for i, n in enumerate("xup"))
    weights = [row for term in terms for row in augmented.rows(term)]
    slope = casadi.jacobian(function(x, u, q)[0], q)[list(rows), weights]
    program = casadi.Function("waves", [x, u, q], [casadi.vec(casadi.densify(slope))])
    sd = np.array([(parameter.high - parameter.low) / 4 for term in terms for parameter in term.parameters])
    found = []
    for states, inputs in points:
        # a model may have no input
        flat = tuple(a.reshape(int(np.prod(states.shape[:-1])), a.shape[-1]).T for a in (states, inputs))
        value = np.asarray(program(*flat, np.tile(p[:, None], flat[0].shape[1]))).reshape(len(sd), len(rows), -1)
        value = np.nan_to_num(value * sd[:, None, None], posinf=0.0, neginf=0.0)
        found.append(np.moveaxis(value, 0, -1).reshape(len(rows), *states.shape[:-1], len(sd)))
    here, there = found
    return {row: (here[i], there[i]) for i, row in enumerate(rows)}
