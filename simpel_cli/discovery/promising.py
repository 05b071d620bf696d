"""What functions of two arguments promise to a model that is fitted already, before any of them is compiled.

Innovations e of variance s are moved by the known unknowns b and by the weights w of a function, de = B db + W w
(`sensitivity`). With prior w ~ N(0, 1), in standard deviations of their own priors, and b taken out of both, the function
earns

    1/2 a^2 g' S^-1 g - 1/2 log|S|,    S = I + a^2 W' W,  g = W' e    (all divided by sqrt(s))

in evidence. Its size a is not known: a few are tried, as equally probable, for with the prior of a large function a small
one would never earn its complexity. Process noise that the force had made necessary goes where the force is known: so less
of it is tried, too, for both models.

Reference: Rao (1948); Bishop (2006), Pattern recognition and machine learning, eq. 3.86 (evidence of a linear model).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.assess import Assessor
from simpel_cli.discovery.augmented import Augmented, augment
from simpel_cli.discovery.fit import LEAST_CURVATURE
from simpel_cli.discovery.residual import Forces
from simpel_cli.discovery.search import Search, Trial
from simpel_cli.discovery.sensitivity import shifts, waves
from simulators.effects import Term

LEVELS = (1.0, 0.3, 0.1, 0.03)  # of the process noise of the state that a force acts on
SIZES = (1.0, 0.3, 0.1)  # of a function, in standard deviations of its prior
NUDGE = 1e-4  # of an unknown's range


class Promise(NamedTuple):
    """What a function would earn in evidence, nats, at the best of its sizes."""

    gain: float
    size: float


def promised(search: Search, assessor: Assessor, chosen: Trial, terms: Sequence[Term]) -> list[Promise]:
    """Return what every function would earn beside the chosen terms.

    Args:
        search: that was run.
        assessor: of its models.
        chosen: the model that it ended with.
        terms: functions without a name, none of them in the compiled program.
    """
    plan = search.plan
    coordinates, states = plan.coordinates, [q.name for q in plan.augmented.model.states]
    n_p, n_r, _ = coordinates.sizes
    found = [Promise(-np.inf, 1.0)] * len(terms)
    functions = [_augmented(search, chosen, term) for term in terms]
    for k, row in enumerate(coordinates.driven):
        own = [i for i, t in enumerate(terms) if t.acts_on == states[row]]
        if not own:
            continue
        noise = n_p + n_r + k
        z = np.tile(chosen.optimum.z, (len(LEVELS), 1))
        z[:, noise] = coordinates.unit(noise, np.array(LEVELS) * coordinates.value(noise, float(z[0, noise])))
        tried = [_tried(search, assessor, chosen, at, [(terms[i], *functions[i]) for i in own], row) for at in z]
        without = np.array([before for before, _ in tried])
        reached = np.max(without[:, None, None] + np.array([gains for _, gains in tried]), axis=0)  # (terms, sizes)
        for i, by_size in zip(own, reached - np.max(without) - np.log(len(SIZES)), strict=True):
            best = int(np.argmax(by_size))
            found[i] = Promise(float(by_size[best]), SIZES[best])
    return found


def _augmented(search: Search, chosen: Trial, term: Term) -> tuple[Augmented, np.ndarray]:
    """Model with the chosen terms and one more, and the values of its parameters, the new one switched off."""
    plan, z = search.plan, chosen.optimum.z
    augmented = augment(plan.augmented.model, [*(search.terms[t] for t in chosen.terms), term], plan.augmented.measured)
    values = {q.name: plan.coordinates.value(i, float(z[i])) for i, q in enumerate(plan.augmented.params)}
    p = [values.get(q.name, v) for q, v in zip(augmented.params, augmented.neutral, strict=True)]
    return augmented, np.array(p)


def _tried(
    search: Search,
    assessor: Assessor,
    chosen: Trial,
    z: np.ndarray,
    functions: Sequence[tuple[Term, Augmented, np.ndarray]],
    row: int,
) -> tuple[float, list[list[float]]]:
    """Log-likelihood that the chosen model reaches at one level of the noise, and what each function adds at each size."""
    plan, windows = search.plan, search.plan.windows
    dt = plan.augmented.model.dt
    told = assessor(z, windows)
    mean, following = (np.asarray(a) for a in (told.track.mean, np.roll(told.track.predicted, -1, axis=1)))
    inputs = Forces(plan.rule, plan.coordinates, dt).inputs(z, windows)
    innovation = np.asarray(told.track.innovation)
    ok = windows.ok > 0
    std = np.sqrt(np.asarray(told.track.variance))
    error = innovation[ok] / std[ok]
    if not (np.isfinite(error).all() and np.isfinite(std[ok]).all()):  # with so little noise the filter diverges
        return -np.inf, [[-np.inf] * len(SIZES) for _ in functions]
    known = _known(search, assessor, chosen, z, innovation) / std[ok][:, None]
    u, size, _ = np.linalg.svd(known, full_matrices=False)
    known = u[:, size**2 > LEAST_CURVATURE]  # what the data tell of them; elsewhere the prior holds them
    left = error - known @ (known.T @ error)
    reached = float(told.log_likelihood.sum() + 0.5 * (error @ error - left @ left))
    gains = []
    for term, augmented, p in functions:
        here, there = waves(augmented, term, p, [(mean, inputs), (following, inputs)])
        columns = shifts(told.track, windows.ok, here, there, row, dt)[ok] / std[ok][:, None]
        gains.append(_evidence(columns, left, known))
    return reached, gains


def _known(search: Search, assessor: Assessor, chosen: Trial, z: np.ndarray, innovation: np.ndarray) -> np.ndarray:
    """Change of the innovations where something was measured per unknown of the chosen model, (N, n)."""
    ok = search.plan.windows.ok > 0
    columns = [np.zeros((int(ok.sum()), 0))]
    for i in (i for i in search.free(chosen.terms) if i not in search.noise):
        near = z.copy()
        step = NUDGE if z[i] < 0.5 else -NUDGE
        near[i] += step
        change = (np.asarray(assessor(near, search.plan.windows).track.innovation) - innovation)[ok] / step
        columns.append(np.nan_to_num(change, posinf=0.0, neginf=0.0)[:, None])
    return np.concatenate(columns, axis=1)


def _evidence(columns: np.ndarray, left: np.ndarray, known: np.ndarray) -> list[float]:
    """Evidence that weights of these columns (N, n) earn at each of SIZES, given what the known unknowns leave (N,)."""
    columns = columns - known @ (known.T @ columns)
    matrix, g = columns.T @ columns, columns.T @ left
    if not (np.isfinite(matrix).all() and np.isfinite(g).all()):
        return [-np.inf] * len(SIZES)
    values, vectors = np.linalg.eigh(matrix)
    pull = (vectors.T @ g) ** 2
    s = 1 + np.square(SIZES)[:, None] * np.maximum(values, 0.0)
    return [float(e) for e in np.sum(np.square(SIZES)[:, None] * pull / s - np.log(s), axis=1) / 2]
