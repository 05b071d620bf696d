"""Score test of many candidates at once: what each promises, without a fit.

At the optimum of a model, switched-off parameters k have a gradient g and information F. With the known unknowns b refitted, a
candidate gains about 1/2 g' S^-1 g, where S = F_kk - F_kb F_bb^-1 F_bk: the Schur complement lets the known parameters
take what they can. Several candidates share one evaluation of the filter, since none of them is switched on.

What has no size that could be switched off, a delay of some rows or a level at which a signal ends, is looked at where it
begins, with the noise of the model without it: it promises what the loss falls by from that model to there, and twice what one
Newton step in all unknowns promises from there, since such a term may lead further than a step tells. A start at which the
model is so wrong that a step promises more than `FAR` cannot tell.

Reference: Rao (1948), Large sample tests of statistical hypotheses; Cox and Hinkley (1974), Theoretical statistics, 9.3.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simpel_cli.filtering.likelihood.steps import LEAST_CURVATURE
from simpel_cli.filtering.setup import Setup
from simulators.effects.term import DELAY


class Score(NamedTuple):
    """What the slope at a switched-off term says, or what a term reaches where it begins.

    Args:
        gain: in log posterior, nats, with the known unknowns refitted; inf where a score cannot tell.
        sd: of the first amplitude, in its range; inf likewise, and where there is none that could be switched off.
        sure: nats that are not hoped for: `gain`, or, of what cannot be switched off, what is reached where it begins.
    """

    gain: float
    sd: float
    sure: float

    @property
    def switched_off(self) -> bool:
        """Whether it is told by the slope at a size of zero."""
        return bool(np.isfinite(self.sd))


UNTOLD = Score(np.inf, np.inf, -np.inf)
FAR = 1000.0  # nats


def promises(
    plan: Setup,
    fit: Callable[[list[Hypothesis], int], list[Optimum]],
    width: int,
    known: tuple[int, ...],
    z: np.ndarray,
    starts: Sequence[tuple[int, Hypothesis]],
    sets: Sequence[tuple[int, ...]] | None = None,
) -> list[Score]:
    """Return what each start of each term promises, or what each set of starts promises together.

    Args:
        plan: of the search.
        fit: of hypotheses, with so many iterations.
        width: free unknowns that a hypothesis may have.
        known: unknowns that move in the model without the terms.
        z: optimum of that model, unit coordinates.
        starts: term and start; parameters whose neutral value is 0 are amplitudes and are switched off, others keep it.
        sets: places in `starts`, of different terms each; None: every start by itself.
    """
    sets = [(i,) for i in range(len(starts))] if sets is None else sets
    terms = plan.augmented.terms
    rows = {term: tuple(plan.augmented.rows(terms[term])) for term, _ in starts}
    room = width - len(known)
    told = [has_size(plan, term, hypothesis) for term, hypothesis in starts]
    groups: list[dict[int, int]] = []  # term -> its start
    group_of: dict[int, int] = {}
    for k, one in enumerate(sets):
        own = {starts[i][0]: i for i in one}
        if not all(told[i] for i in one):  # several at once cannot tell
            continue
        for g, group in enumerate(groups):
            both = group | own
            alike = all(group.get(term, i) == i for term, i in own.items())
            if alike and sum(len(rows[term]) for term in both) <= room:
                groups[g], group_of[k] = both, g
                break
        else:
            groups.append(own)
            group_of[k] = len(groups) - 1
    ones = np.ones(len(plan.windows.episode))
    hypotheses = []
    for group in groups:
        start = z.copy()
        for term, i in group.items():
            for row, parameter in zip(rows[term], terms[term].parameters, strict=True):
                start[row] = plan.start[row] if parameter.neutral == 0 else starts[i][1].z[row]
        hypotheses.append(Hypothesis(start, known + tuple(r for term in group for r in rows[term]), ones))
    # what cannot be switched off, by itself; the model without it comes first
    begun = [
        k for k, one in enumerate(sets)
        if k not in group_of and len(one) == 1 and not terms[starts[one[0]][0]].groupings
    ]  # fmt: skip
    if begun:
        hypotheses.append(Hypothesis(z, known, ones))
    for k in begun:
        term, hypothesis = starts[sets[k][0]]
        start = z.copy()
        start[list(rows[term])] = hypothesis.z[list(rows[term])]
        hypotheses.append(Hypothesis(start, known + rows[term], ones))
    optima = fit(hypotheses, 1)
    found = [UNTOLD] * len(sets)
    if begun:
        without, *with_it = optima[len(groups) :]
        for k, optimum in zip(begun, with_it, strict=True):
            found[k] = _at_start(without, optimum)
    for k, g in group_of.items():
        optimum = optima[g]
        moved = [
            optimum.free.index(row)
            for i in sets[k]
            for row, parameter in zip(rows[starts[i][0]], terms[starts[i][0]].parameters, strict=True)
            if parameter.neutral == 0
        ]
        found[k] = _promise(optimum.gradient, optimum.fisher, moved, len(known), optimum.z[list(optimum.free)])
    return found


def _at_start(without: Optimum, optimum: Optimum) -> Score:
    """Gain from a model to one with a term where it begins, and by a step from there."""
    if not max(optimum.step, without.step) < FAR:
        return UNTOLD
    reached = without.loss - optimum.loss
    return Score(reached + 2 * (optimum.step - without.step), np.inf, reached)


def has_size(plan: Setup, place: int, start: Hypothesis) -> bool:
    """Whether a term has a size, where it begins, that can be switched off; of a delay of rows no slope at none tells."""
    term = plan.augmented.terms[place]
    row = plan.augmented.rows(term)[0]
    late = term.kind == DELAY and plan.coordinates.value(row, start.z[row]) > plan.augmented.model.dt
    return not term.groupings and any(k.neutral == 0 for k in term.parameters) and not late


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
    gain = float(0.5 * g @ np.linalg.solve(schur, g)) if kept else 0.0
    return Score(gain, sd, gain)
