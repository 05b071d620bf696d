"""Ranges that turn out to be too narrow: of the simulator's parameters, and of effects.

A range is what its author thought possible. Where a fit stands at an end of one, that end may be what keeps it from the truth,
and effects are found that only make up for it: a heater weaker than its range allows looks like one that saturates. So the fit
is made once more with wider ranges; since the prior spreads over more, evidence says whether it pays. What a sign or a
conservation law forbids stays forbidden: no range is widened across zero.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.again import Earlier
from simpel_cli.discovery.search.trials import ACCEPT, TIE, Search, Trial
from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simpel_cli.filtering.setup import Setup
from simulators.effects import Expression
from simulators.groups import MEMBER, SPREAD
from simulators.model import Model

AT_END = 0.005  # of a range: a fit that ends so near to an end of it
TIMES = 2.0  # spans by which a range becomes wider at that end
NEAREST = 0.1  # of a bound that is not zero: as near to zero as a wider range comes
NEARLY_ALL = 0.8  # of what the best effect gains (0.83 on the heaters of TCLab, where it is the range)
MOST_WIDER = 3  # times that ranges become wider, each by so many steps at most

Range = tuple[float, float]


class Wider(NamedTuple):
    """Ranges that pay.

    Args:
        ranges: by the names of their parameters.
        gain: nats of evidence.
        earlier: what was chosen without them.
        simulated: likewise by simulations, where these ask for them.
    """

    ranges: dict[str, Range]
    gain: float
    earlier: Earlier | None = None
    simulated: Earlier | None = None


def too_narrow(search: Search, trial: Trial) -> Wider | None:
    """Return the wider ranges with which a model gains; None: there are none.

    A fit that stands at the end of a wider range, too, asks at once for the next one, not in a search of its own: the whole
    model as long as that pays, the simulator alone and the rest of a model until they gain what is asked of them. Beyond that
    a range would make up for what is missing.

    The simulator alone has to gain with them nearly what it gains with the best effect, or the rest of a model what an effect
    adds to it: that may only make up for them, and that a range is too narrow is the simpler cause.
    """
    if not trial.terms:
        wider = _wider(search.plan, trial)
        trials = search.add(trial, search.candidates(())).trials if wider else ()
        best = trials[0].optimum.log_evidence - trial.optimum.log_evidence if trials else 0.0
        return _paying(search, trial, NEARLY_ALL * best - TIE)
    if (found := _paying(search, trial, 0.0, whole=True)) is not None:
        return found
    for gone in trial.terms:
        rest = search.part(trial, tuple(t for t in trial.terms if t != gone))
        earned = trial.optimum.log_evidence - rest.optimum.log_evidence
        if (found := _paying(search, rest, NEARLY_ALL * earned - TIE)) is not None:
            return found
    return None


def _paying(search: Search, trial: Trial, least: float, *, whole: bool = False) -> Wider | None:
    """Return the wider ranges with which a model gains so many nats, and what they have to earn; None: it does not.

    Args:
        search: that it comes from.
        trial: the model.
        least: nats.
        whole: whether it is what stands, not a part of that: its ranges widen as long as that pays.
    """
    plan, wide, found = search.plan, search.plan, None
    names, before, ranges = [q.name for q in plan.augmented.params], trial, dict[int, Range]()
    for _ in range(MOST_WIDER):
        if (found and not whole) or not (wider := _wider(wide, before)):
            break
        wide, z = _ranged(wide, before.optimum.z, wider)
        after = Trial(trial.terms, max(_fitted(search, trial, wide, z), key=lambda o: o.log_evidence))
        if not after.optimum.log_evidence - before.optimum.log_evidence > ACCEPT * len(wider):
            break
        ranges |= wider
        gain = after.optimum.log_evidence - trial.optimum.log_evidence
        if gain > least:
            found = Wider({names[row]: ends for row, ends in ranges.items()}, float(gain))
        before = after
    return found


def widened(model: Model, effects: Sequence[Expression], ranges: Mapping[str, Range]) -> tuple[Model, list[Expression]]:
    """Return the simulator and the effects with wider ranges of the parameters that are named."""
    own = {q.name for q in model.params}
    ends = {q.name: ranges.get(q.name, (q.low, q.high)) for q in model.params}
    params = tuple(q._replace(low=ends[q.name][0], high=ends[q.name][1]) for q in model.params)
    base = model.base and widened(model.base, [], ranges)[0]
    rest = {name: ends for name, ends in ranges.items() if name not in own}
    more = [replace(e, widened=dict(e.widened) | rest) for e in effects] if rest else list(effects)
    return replace(model, params=params, base=base), more


def narrowed(search: Search, given: Mapping[str, Range]) -> Search | None:
    """Return the search in other ranges, by the names of their parameters; None: they are the same."""
    plan = search.plan
    declared = {row: given[q.name] for row, q in enumerate(plan.augmented.params)
                if q.name in given and given[q.name] != (q.low, q.high)}  # fmt: skip
    if not declared:
        return None
    narrow, _ = _ranged(plan, plan.start, declared)
    return Search(narrow, search.fitter.within(narrow.coordinates), search.report)


def within(search: Search, narrow: Search, trial: Trial) -> Trial:
    """Return a model of one search fitted in the other ranges of another, in the coordinates of that."""
    z = translated(search, narrow, trial).optimum.z
    starts = [Hypothesis(at, trial.optimum.free, search.ones) for at in (z, narrow.loud(z))]
    return Trial(trial.terms, max(narrow.fitter(starts), key=lambda o: o.log_evidence))


def translated(old: Search, new: Search, trial: Trial) -> Trial:
    """Return a fit of one search in the coordinates of another with other ranges; values beyond an end lie at it."""
    before, after, optimum = old.plan.coordinates, new.plan.coordinates, trial.optimum
    z, centre, scale = optimum.z.copy(), optimum.centre.copy(), np.ones(len(optimum.free))
    moved = np.flatnonzero((before.low != after.low) | (before.high != after.high))
    for row in (int(i) for i in moved if i < len(z)):
        z[row] = after.unit(row, before.value(row, float(z[row])))
        if row in optimum.free:
            k, span = optimum.free.index(row), after.high[row] - after.low[row]
            scale[k] = (before.high[row] - before.low[row]) / span
            mean = np.clip(centre[k], 0.0, 1.0)  # of a Gaussian, which knows no end
            centre[k] = scale[k] * mean + (before.low[row] - after.low[row]) / span
    both = np.outer(scale, scale)
    return Trial(
        trial.terms,
        optimum._replace(
            z=z, centre=centre, covariance=optimum.covariance * both, fisher=optimum.fisher / both,
            gradient=optimum.gradient / scale,
        ),
    )  # fmt: skip


def in_words(found: Wider) -> str:
    """Return a line for the log."""
    return f"{', '.join(found.ranges)} at the end of a range; with a wider one +{found.gain:.0f}: searching there"


def _wider(plan: Setup, trial: Trial) -> dict[int, Range]:
    """Return wider ranges of the unknowns of a model that stand at an end that may move.

    Of an effect only its strength: widths and exponents have ranges that say what the effect is.
    """
    coordinates, found = plan.coordinates, dict[int, Range]()
    shapes = {
        i for t in plan.augmented.terms for i, k in zip(plan.augmented.rows(t), t.parameters, strict=True) if k.neutral
    }
    for row in trial.optimum.free:
        if row >= coordinates.sizes[0] or coordinates.log[row] or coordinates.normal[row]:
            continue
        q, at = plan.augmented.params[row], float(trial.optimum.z[row])
        if q.role in (SPREAD, MEMBER) or row in shapes:
            continue
        low, high = float(coordinates.low[row]), float(coordinates.high[row])
        span = high - low
        if at < AT_END and low != 0:
            found[row] = (max(low - TIMES * span, NEAREST * low) if low > 0 else low - TIMES * span, high)
        elif at > 1 - AT_END and high != 0:
            found[row] = (low, min(high + TIMES * span, NEAREST * high) if high < 0 else high + TIMES * span)
    return found


def _ranged(plan: Setup, z: np.ndarray, ranges: Mapping[int, Range]) -> tuple[Setup, np.ndarray]:
    """Return a setup with other ranges of some unknowns, and what z is in it."""
    low, high = plan.coordinates.low.copy(), plan.coordinates.high.copy()
    for row, ends in ranges.items():
        low[row], high[row] = ends
    coordinates = plan.coordinates._replace(low=low, high=high)
    start, at = plan.start.copy(), z.copy()
    for row in ranges:
        start[row], at[row] = (coordinates.unit(row, plan.coordinates.value(row, float(v[row]))) for v in (start, z))
    return plan._replace(coordinates=coordinates, start=start, optimum=None), at


def _fitted(search: Search, trial: Trial, plan: Setup, z: np.ndarray) -> list[Optimum]:
    starts = (z, search.loud(z))
    return search.fitter.within(plan.coordinates)([Hypothesis(at, trial.optimum.free, search.ones) for at in starts])
