"""Score test of many candidates at once: what each promises, without a fit.

At the optimum of a model, switched-off parameters k have a gradient g and information F. With the known unknowns b refitted, a
candidate gains about 1/2 g' S^-1 g, where S = F_kk - F_kb F_bb^-1 F_bk: the Schur complement lets the known parameters
take what they can. Several candidates share one evaluation of the filter, since none of them is switched on.

Reference: Rao (1948), Large sample tests of statistical hypotheses; Cox and Hinkley (1974), Theoretical statistics, 9.3.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.filtering.likelihood.fit import LEAST_CURVATURE, Hypothesis, Optimum
from simpel_cli.filtering.setup import Setup
from simulators.effects.term import DELAY


class Score(NamedTuple):
    """What the slope at a switched-off term says.

    Args:
        gain: in log posterior, nats, with the known unknowns refitted; inf where a score cannot tell.
        sd: of the first amplitude, in its range; inf likewise.
    """

    gain: float
    sd: float


UNTOLD = Score(np.inf, np.inf)


def promises(
    plan: Setup,
    fit: Callable[[list[Hypothesis], int], list[Optimum]],
    width: int,
    known: tuple[int, ...],
    z: np.ndarray,
    starts: Sequence[tuple[int, Hypothesis]],
) -> list[Score]:
    """Return what each start of each term promises.

    Args:
        plan: of the search.
        fit: of hypotheses, with so many iterations.
        width: free unknowns that a hypothesis may have.
        known: unknowns that move in the model without the term.
        z: optimum of that model, unit coordinates.
        starts: term and start; parameters whose neutral value is 0 are amplitudes and are switched off, others keep it.
    """
    terms = plan.augmented.terms
    rows = {term: tuple(plan.augmented.rows(terms[term])) for term, _ in starts}
    room = width - len(known)
    groups: list[list[int]] = []
    for i, (term, hypothesis) in enumerate(starts):
        if (
            terms[term].groupings
            or not any(k.neutral == 0 for k in terms[term].parameters)
            or _late(plan, term, rows[term][0], hypothesis)
        ):
            continue
        for group in groups:
            used = {starts[j][0] for j in group}
            if term not in used and len(rows[term]) + sum(len(rows[t]) for t in used) <= room:
                group.append(i)
                break
        else:
            groups.append([i])
    ones = np.ones(len(plan.windows.episode))
    hypotheses = []
    for group in groups:
        start = z.copy()
        for i in group:
            term, hypothesis = starts[i]
            for row, parameter in zip(rows[term], terms[term].parameters, strict=True):
                start[row] = plan.start[row] if parameter.neutral == 0 else hypothesis.z[row]
        hypotheses.append(Hypothesis(start, known + tuple(r for i in group for r in rows[starts[i][0]]), ones))
    found = [UNTOLD] * len(starts)
    for group, optimum in zip(groups, fit(hypotheses, 1), strict=True):
        for i in group:
            term = starts[i][0]
            moved = [
                optimum.free.index(row)
                for row, parameter in zip(rows[term], terms[term].parameters, strict=True)
                if parameter.neutral == 0
            ]
            found[i] = _promise(optimum.gradient, optimum.fisher, moved, len(known), optimum.z[list(optimum.free)])
    return found


def _late(plan: Setup, term: int, row: int, hypothesis: Hypothesis) -> bool:
    """Whether a term begins as a delay of more than a row: a slope at none tells nothing of that."""
    late = plan.coordinates.value(row, hypothesis.z[row]) > plan.augmented.model.dt
    return plan.augmented.terms[term].kind == DELAY and late


def _promise(gradient: np.ndarray, fisher: np.ndarray, rows: list[int], known: int, at: np.ndarray) -> Score:
    """Gain of moving the parameters `rows`, those at a bound only inwards, while the first `known` unknowns follow."""
    inward = [r for r in rows if not (at[r] <= 0 and gradient[r] >= 0) and not (at[r] >= 1 and gradient[r] <= 0)]
    if not np.isfinite(fisher).all() or not any(fisher[r, r] > 0 for r in rows):
        return UNTOLD
    base = fisher[:known, :known] + LEAST_CURVATURE * np.eye(known)
    cross = fisher[:known, rows]
    schur = fisher[np.ix_(rows, rows)] - cross.T @ np.linalg.solve(base, cross)
    schur += LEAST_CURVATURE * np.eye(len(rows))
    g = gradient[rows] - cross.T @ np.linalg.solve(base, gradient[:known])
    sd = float(np.sqrt(np.linalg.inv(schur)[0, 0]))
    kept = [rows.index(r) for r in inward]
    g, schur = g[kept], schur[np.ix_(kept, kept)]
    return Score(float(0.5 * g @ np.linalg.solve(schur, g)) if kept else 0.0, sd)
