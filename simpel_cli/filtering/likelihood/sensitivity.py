"""What a force would do to the innovations of a filter that does not know of it, to first order along its track.

    d[k+1] = F[k] d+[k] + dt/2 (F[k] a[k] + a'[k]),    d+[k] = (I - K[k] H[k]) d[k],    de[k] = -H[k] d[k]

a[k] is the force at the filtered state of row k, a'[k] at the one predicted from it, both with the input of row k. So
any number of forces is tried on one run of the filter, and no program is compiled for them. What they do to the gains K, by
way of the slopes F, is left out.

Reference: Jazwinski (1970), Stochastic processes and filtering theory, ch. 8 (the filter's equations, linearised).
"""

from collections.abc import Sequence

import casadi
import numpy as np

from simpel_cli.filtering.likelihood.augmented import Augmented
from simpel_cli.filtering.likelihood.track import Track
from simulators.effects import Term


def shifts(
    track: Track, ok: np.ndarray, force: np.ndarray, following: np.ndarray, row: int, dt: float,
    reading: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the change of every innovation per unit of each force, (W, T, ny, n); 0 where nothing was measured.

    Args:
        track: of the filter, (W, T, ...) each.
        ok: (W, T, ny) whether it was measured.
        force: (W, T, n) at the filtered states, per second.
        following: (W, T, n) at the states predicted from them.
        row: of the state whose rate the forces act on.
        dt: s.
        reading: (W, T, ny, n) what is added to what sensors read; None: nothing.
    """
    count, rows, nx = track.mean.shape
    n = force.shape[-1]
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
        d = np.einsum("wij,wjn->win", f, d) + dt / 2 * f[:, :, row, None] * force[:, k, None]
        d[:, row] += dt / 2 * following[:, k]
    return found


def waves(
    augmented: Augmented, term: Term, p: np.ndarray, points: Sequence[tuple[np.ndarray, np.ndarray]], acts_on: str = ""
) -> list[np.ndarray]:
    """Return what each weight of a function adds to a rate, per standard deviation of its prior, (..., n) per entry.

    Args:
        augmented: a model that has the term.
        term: a function without a name: linear in its parameters, which have normal priors.
        p: (dp,) values of all parameters.
        points: states (..., nx) and inputs (..., nu).
        acts_on: state whose rate it is; empty: that of the term.
    """
    function = augmented.function
    x, u, q = (augmented.model.symbol.sym(n, function.size1_in(i)) for i, n in enumerate("xup"))
    row = [s.name for s in augmented.model.states].index(acts_on or term.acts_on)
    slope = casadi.jacobian(function(x, u, q)[0][row], q)[:, augmented.rows(term)]
    program = casadi.Function("waves", [x, u, q], [casadi.densify(slope).T])
    sd = np.array([(parameter.high - parameter.low) / 4 for parameter in term.parameters])
    found = []
    for states, inputs in points:
        # a model may have no input
        flat = tuple(a.reshape(int(np.prod(states.shape[:-1])), a.shape[-1]).T for a in (states, inputs))
        value = np.asarray(program(*flat, np.tile(p[:, None], flat[0].shape[1])))
        found.append(np.nan_to_num(value.T * sd, posinf=0.0, neginf=0.0).reshape(*states.shape[:-1], len(sd)))
    return found
