"""Score test of many candidates at once: what each promises, without a fit.

At the optimum of a model, switched-off knobs k have a gradient g and information F. With the known unknowns b refitted, a
candidate gains about 1/2 g' S^-1 g, where S = F_kk - F_kb F_bb^-1 F_bk: the Schur complement lets the known parameters
take what they can. Several candidates share one evaluation of the filter, since none of them is switched on.

Reference: Rao (1948), Large sample tests of statistical hypotheses; Cox and Hinkley (1974), Theoretical statistics, 9.3.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from simpel_cli.discovery.fit import LEAST_CURVATURE, Lane
from simulators.effects.term import DELAY

if TYPE_CHECKING:
    from simpel_cli.discovery.search import Search, Trial


class Score(NamedTuple):
    """What the slope at a switched-off term says.

    Args:
        gain: in log posterior, nats, with the known unknowns refitted; inf where a score cannot tell.
        sd: of the first amplitude, in its range; inf likewise.
    """

    gain: float
    sd: float


UNTOLD = Score(np.inf, np.inf)


def promises(search: "Search", before: "Trial", starts: Sequence[tuple[int, Lane]]) -> list[Score]:
    """Return what each start of each term promises.

    Args:
        search: whose fitter is used.
        before: the model without the term, at its optimum.
        starts: term and start; knobs whose neutral value is 0 are amplitudes and are switched off, others keep it.
    """
    plan = search.plan
    known = search.free(before.terms)
    room = search.fitter.width - len(known)
    groups: list[list[int]] = []
    for i, (term, lane) in enumerate(starts):
        if not any(k.neutral == 0 for k in search.terms[term].knobs) or _late(search, term, lane):
            continue
        size = len(search.rows[term])
        for group in groups:
            used = {starts[j][0] for j in group}
            if term not in used and size + sum(len(search.rows[t]) for t in used) <= room:
                group.append(i)
                break
        else:
            groups.append([i])
    lanes = []
    for group in groups:
        z = before.optimum.z.copy()
        for i in group:
            for row, knob in zip(search.rows[starts[i][0]], search.terms[starts[i][0]].knobs, strict=True):
                z[row] = plan.start[row] if knob.neutral == 0 else starts[i][1].z[row]
        lanes.append(Lane(z, known + tuple(r for i in group for r in search.rows[starts[i][0]]), search.ones))
    found = [UNTOLD] * len(starts)
    for group, optimum in zip(groups, search.fitter(lanes, 1), strict=True):
        for i in group:
            rows = [
                optimum.free.index(row)
                for row, knob in zip(search.rows[starts[i][0]], search.terms[starts[i][0]].knobs, strict=True)
                if knob.neutral == 0
            ]
            found[i] = _promise(optimum.gradient, optimum.fisher, rows, len(known), optimum.z[list(optimum.free)])
    return found


def _late(search: "Search", term: int, lane: Lane) -> bool:
    """Whether a term begins as a delay of more than a row: a slope at none tells nothing of that."""
    row, plan = search.rows[term][0], search.plan
    return search.terms[term].kind == DELAY and plan.coordinates.value(row, lane.z[row]) > plan.augmented.model.dt


def _promise(gradient: np.ndarray, fisher: np.ndarray, rows: list[int], known: int, at: np.ndarray) -> Score:
    """Gain of moving the knobs `rows`, those at a bound only inwards, while the first `known` unknowns follow."""
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
