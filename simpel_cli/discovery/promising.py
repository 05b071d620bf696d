"""What functions of two arguments promise to a model that is fitted already, before any of them is compiled.

Innovations e of variance s are moved by the known unknowns b and by the weights w of a function, de = B db + W w
(`sensitivity`). With prior w ~ N(0, 1), in standard deviations of their own priors, and b taken out of both, the function
earns

    1/2 g' S^-1 g - 1/2 log|S|,    S = I + W' W,  g = W' e    (all divided by sqrt(s))

in evidence. Process noise that the force had made necessary goes where the force is known: so that is tried with less of it,
too, for both models.

Reference: Rao (1948); Bishop (2006), Pattern recognition and machine learning, eq. 3.86 (evidence of a linear model).
"""

from collections.abc import Sequence

import numpy as np

from simpel_cli.discovery.assess import Assessor
from simpel_cli.discovery.augmented import augment
from simpel_cli.discovery.fit import LEAST_CURVATURE
from simpel_cli.discovery.residual import Forces
from simpel_cli.discovery.selection import Search, Trial
from simpel_cli.discovery.sensitivity import shifts, waves
from simulators.effects import Term

LEVELS = (1.0, 0.3, 0.1, 0.03)  # of the process noise of the state that a force acts on
NUDGE = 1e-4  # of an unknown's range


def promised(search: Search, assessor: Assessor, chosen: Trial, terms: Sequence[Term]) -> list[float]:
    """Return the evidence that every function would earn beside the chosen terms, nats.

    Args:
        search: that was run.
        assessor: of its models.
        chosen: the model that it ended with.
        terms: functions without a name, none of them in the compiled program.
    """
    plan, windows = search.plan, search.plan.windows
    model, coordinates = plan.augmented.model, plan.coordinates
    z = chosen.optimum.z
    inputs = Forces(plan.rule, coordinates, model.dt).inputs(z, windows)
    values = {q.name: coordinates.value(i, float(z[i])) for i, q in enumerate(plan.augmented.params)}
    states = [q.name for q in model.states]
    n_p, n_r, _ = coordinates.sizes
    found = [-np.inf] * len(terms)
    for k, row in enumerate(coordinates.driven):
        own = [i for i, t in enumerate(terms) if t.acts_on == states[row]]
        noise = n_p + n_r + k
        without, gains = [], []
        for level in LEVELS if own else ():
            at = z.copy()
            at[noise] = coordinates.unit(noise, level * coordinates.value(noise, float(z[noise])))
            told = assessor(at, windows)
            scale = windows.ok / np.sqrt(told.track.variance)
            error = (told.track.innovation * scale).ravel()
            known = _known(search, assessor, chosen, at, told.track.innovation, scale)
            left = error - known @ (known.T @ error)
            reached = float(told.log_likelihood.sum() + 0.5 * (error @ error - left @ left))
            without.append(reached if np.isfinite(reached) else -np.inf)
            following = np.roll(told.track.predicted, -1, axis=1)
            gains.append([])
            for i in own:
                augmented = augment(model, [*(search.terms[t] for t in chosen.terms), terms[i]], plan.augmented.measured)
                p = np.array([values.get(q.name, v) for q, v in zip(augmented.params, augmented.neutral, strict=True)])
                force = waves(augmented, terms[i], p, [(told.track.mean, inputs), (following, inputs)])
                columns = shifts(told.track, windows.ok, *force, row, model.dt) * scale[..., None]
                gains[-1].append(_evidence(columns.reshape(len(error), -1), left, known))
        for i, gain in zip(own, np.array(gains).T, strict=True):
            found[i] = float(np.max(np.array(without) + gain) - np.max(without))
    return found


def _known(
    search: Search, assessor: Assessor, chosen: Trial, z: np.ndarray, innovation: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Orthonormal basis of what the unknowns of the chosen model can do to the innovations, (N, n)."""
    columns = []
    for i in (i for i in search.free(chosen.terms) if i not in search.noise):
        near = z.copy()
        step = NUDGE if z[i] < 0.5 else -NUDGE
        near[i] += step
        change = (assessor(near, search.plan.windows).track.innovation - innovation) / step
        columns.append(np.nan_to_num(change * scale).ravel())
    if not columns:
        return np.zeros((scale.size, 0))
    u, size, _ = np.linalg.svd(np.array(columns).T, full_matrices=False)
    return u[:, size**2 > LEAST_CURVATURE]  # what the data tell of them; elsewhere the prior holds them


def _evidence(columns: np.ndarray, left: np.ndarray, known: np.ndarray) -> float:
    """Evidence that weights of these columns (N, n) earn, given what the known unknowns leave (N,)."""
    columns = columns - known @ (known.T @ columns)
    s = np.eye(columns.shape[1]) + columns.T @ columns
    g = columns.T @ left
    if not (np.isfinite(s).all() and np.isfinite(g).all()):
        return -np.inf
    return float(0.5 * g @ np.linalg.solve(s, g) - 0.5 * np.linalg.slogdet(s)[1])
