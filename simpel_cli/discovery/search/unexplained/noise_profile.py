"""How well a fitted model does at several levels of its process noise, and what its known unknowns leave unexplained.

Process noise that a missing force had made necessary goes where the force is known. So whoever asks what a force would earn
that no program carries asks at less of it, too, for the model with and without.

Innovations e of variance s are moved by the known unknowns b and by the weights w of a force, de = B db + W w
(`sensitivity`). With prior w ~ N(0, a^2) and b taken out of both, the force earns

    1/2 a^2 g' S^-1 g - 1/2 log|S|,    S = I + a^2 W' W,  g = W' e    (all divided by sqrt(s))

in evidence.

Reference: Rao (1948); Bishop (2006), Pattern recognition and machine learning, eq. 3.86 (evidence of a linear model).
"""

from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.latent_force import Forces
from simpel_cli.filtering.likelihood.steps import LEAST_CURVATURE
from simpel_cli.filtering.likelihood.track import Track
from simpel_cli.filtering.tracks import Tracks

LEVELS = (1.0, 0.3, 0.1, 0.03)  # of the process noise of the state that a force acts on
NUDGE = 1e-4  # of an unknown's range


class Level(NamedTuple):
    """A model at one level of the noise; 0 where nothing was measured.

    Args:
        reached: log-likelihood, its known unknowns where they do best to first order.
        track: of the filter.
        inputs: (W, T, nu) as they arrive.
        error: (W, T, ny) innovations that the known unknowns leave, in standard deviations.
        known: (W, T, ny, n) orthonormal directions in which those move the innovations.
        per_std: (W, T, ny) 1 over the innovations' standard deviations.
    """

    reached: float
    track: Track
    inputs: np.ndarray
    error: np.ndarray
    known: np.ndarray
    per_std: np.ndarray


class NoiseProfile:
    """A chosen model at every level of the noise of one state; what was computed is kept."""

    def __init__(self, search: Search, assessor: Assessor, chosen: Trial) -> None:
        self.search, self.assessor, self.chosen = search, assessor, chosen
        plan = search.plan
        self.inputs = Forces(plan.rule, plan.coordinates, plan.augmented.model.dt).inputs(
            chosen.optimum.z, plan.windows
        )
        self._found: dict[int, list[Level]] = {}

    def __call__(self, row: int) -> list[Level]:
        """Return the levels at which the filter does not diverge.

        Args:
            row: of the driven state whose process noise is taken down.
        """
        if row not in self._found:
            coordinates, z = self.search.plan.coordinates, self.chosen.optimum.z
            i = sum(coordinates.sizes[:2]) + coordinates.driven.index(row)
            self._found[row] = []
            for level in LEVELS:
                at = z.copy()
                at[i] = coordinates.unit(i, level * coordinates.value(i, float(z[i])))
                self._found[row] += self._at(at)
        return self._found[row]

    def _at(self, z: np.ndarray) -> list[Level]:
        windows = self.search.plan.windows
        ok = windows.ok > 0
        assessed = self.assessor(z, windows)
        innovation, variance = (np.asarray(a) for a in (assessed.track.innovation, assessed.track.variance))
        with np.errstate(invalid="ignore", divide="ignore"):
            per_std = np.where(ok, 1 / np.sqrt(variance), 0.0)
        error = np.where(ok, innovation, 0.0) * per_std
        if not (np.isfinite(error).all() and np.isfinite(per_std).all()):  # with so little noise the filter diverges
            return []
        moved = [c * per_std for c in self._moves(z, innovation)]
        directions = np.stack(moved, axis=-1) if moved else np.zeros((*error.shape, 0))
        u, size, _ = np.linalg.svd(directions.reshape(error.size, -1), full_matrices=False)
        known = u[:, size**2 > LEAST_CURVATURE]  # what the data tell of them; elsewhere the prior holds them
        left = error.ravel() - known @ (known.T @ error.ravel())
        reached = float(assessed.log_likelihood.sum() + 0.5 * (np.sum(error**2) - left @ left))
        known = known.reshape(*error.shape, -1)
        return [Level(reached, assessed.track, self.inputs, left.reshape(error.shape), known, per_std)]

    def _moves(self, z: np.ndarray, innovation: np.ndarray) -> list[np.ndarray]:
        """Change of the innovations per unknown of the chosen model, (W, T, ny) each; 0 where nothing was measured."""
        search, windows = self.search, self.search.plan.windows
        tracks, found = Tracks(search.plan), []
        for i in (i for i in search.free(self.chosen.terms) if i not in search.noise):
            near = z.copy()
            step = NUDGE if z[i] < 0.5 else -NUDGE
            near[i] += step
            change = (tracks.track(near, windows).innovation - innovation) / step
            found.append(np.where((windows.ok > 0) & np.isfinite(change), change, 0.0))
        return found


def evidence(matrix: np.ndarray, pull: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the evidence that weights earn, nats, (k,); -inf where it is not finite.

    Args:
        matrix: (n, n) W' W of what they do to the innovations.
        pull: (n,) W' e.
        sizes: (k,) standard deviations a of their prior.
    """
    if not (np.isfinite(matrix).all() and np.isfinite(pull).all()):
        return np.full(len(sizes), -np.inf)
    values, vectors = np.linalg.eigh(matrix)
    along = (vectors.T @ pull) ** 2
    s = 1 + np.square(sizes)[:, None] * np.maximum(values, 0.0)
    return np.sum(np.square(sizes)[:, None] * along / s - np.log(s), axis=1) / 2
