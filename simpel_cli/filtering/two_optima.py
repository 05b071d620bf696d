"""Two optima of the noise: a model may follow its sensors, or trust its equations.

With noise of a sensor at its least and process noise loud, a filter follows what it reads: that is an optimum, in which the
right model with the right parameters may come to rest, too, since it passed by wrong ones. The other, quiet process noise and a
sensor as noisy as its readings look, may be worth a hundred nats more. No step leads from one to the other, so the fit is made
once more from there.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simpel_cli.filtering.race import hopeful
from simpel_cli.filtering.setup import Setup

FIRST = 3  # models of a stage that are fitted once more; the others where it pays for one of these
SHARE = 0.2  # of what the best gains, which they have to
FOLLOWS = 0.01  # of the range of a sensor's noise: at its least
QUIET = 0.1  # of the range of process noise
BETTER = 1.0  # nats


def trusting(plan: Setup, z: np.ndarray) -> np.ndarray:
    """Return a start with quiet process noise, and sensors as noisy as their readings look."""
    z = z.copy()
    n_p, n_r, n_q = plan.coordinates.sizes
    r, q = np.arange(n_p, n_p + n_r), np.arange(n_p + n_r, n_p + n_r + n_q)
    z[r] = np.where(z[r] < FOLLOWS, plan.start[r], z[r])
    z[q] = np.minimum(z[q], QUIET)
    return z


def other_optima(
    plan: Setup, fit: Callable[..., list[Optimum]], found: Sequence[Optimum], least: float
) -> list[Optimum]:
    """Return models of one stage, of which those that follow a sensor were fitted once more; the better fit of each.

    Args:
        plan: of the search.
        fit: of hypotheses, as a `Fitter`.
        found: best first.
        least: evidence of what they are compared with, nats; -inf: of nothing.
    """
    n_p, n_r, _ = plan.coordinates.sizes
    ones = np.ones(len(plan.windows.episode))
    most = max((o.log_evidence - least for o in found), default=0.0)

    def follows(o: Optimum) -> bool:
        low = bool(np.any(o.z[n_p : n_p + n_r] < FOLLOWS))
        much = not np.isfinite(least) or o.log_evidence - least > SHARE * most
        return low and bool(np.isfinite(o.loss)) and much

    going = [i for i, o in enumerate(found) if follows(o)]
    new = list(found)
    for part in (going[:FIRST], going[FIRST:]):
        losses = [found[i].loss for i in part]
        fits = fit(
            [Hypothesis(trusting(plan, found[i].z), found[i].free, ones) for i in part], hopes=partial(_ahead, losses)
        )
        fits_of = [(i, o) for i, o in zip(part, fits, strict=True) if not o.left]
        better = [(i, o) for i, o in fits_of if o.log_evidence > found[i].log_evidence + BETTER]
        for i, o in better:
            new[i] = o
        if not better:
            break
    return new


def _ahead(losses: Sequence[float], optima: Sequence[Optimum]) -> list[bool]:
    return hopeful(optima, losses)
