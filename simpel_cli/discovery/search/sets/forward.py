"""Which effects the model lacks: forward and backward selection by evidence.

A named effect has to beat every other name and every function without one; names that do as well form a class. Two effects
have to beat every single term in place of both.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.sets.merging import merged
from simpel_cli.discovery.search.sets.pairs import together
from simpel_cli.discovery.search.sets.rivals import rivalled
from simpel_cli.discovery.search.sets.selection import Selection, nameless, path_of, worth
from simpel_cli.discovery.search.trials import ACCEPT, ASTRAY, TIE, Search, Stage, Trial, asked
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simulators.effects import Term

MOST_EFFECTS = 8
MOST_MERGERS = 2
MOST_RUNNERS_UP = 8  # effects that a search could begin with
BEGINNINGS = 2  # that it does begin with, beside the one that explains most
GUARD = 1000.0  # nats: so large a gain says that the smaller model had not found its optimum
FAR_MORE = 1.5  # times as much as everything else, which an effect of the best path promises
MOST_BEHIND = 2  # effects in a row with which a path may be worth less than the best one so far with as many


class _Grown(NamedTuple):
    """Where adding effects ended: the fits on the way, what was tried, and an unnamed function still asked for.

    `cut`: it went no further since another path led.
    """

    path: tuple[Trial, ...]
    stages: tuple[Stage, ...]
    remainder: tuple[Term, float] | None
    cut: bool = False


def select(
    search: Search, base: Trial | None = None, beginnings: int = BEGINNINGS, begun: tuple[Trial, ...] = ()
) -> Selection:
    """Search, from the calibrated simulator if it is known already; one effect in place of two, and rivals of what was chosen.

    Args: as of `selected`.
    """
    return rivalled(search, condensed(search, selected(search, base, beginnings, begun)))


def selected(
    search: Search, base: Trial | None = None, beginnings: int = BEGINNINGS, begun: tuple[Trial, ...] = (), *,
    settled: bool = False,
) -> Selection:  # fmt: skip
    """Search, from the calibrated simulator if it is known already; one effect in place of two is not asked yet, nor rivals.

    Args:
        search: over the sets of effects of one setup.
        base: its calibrated simulator.
        beginnings: first effects that are tried beside the one that explains most, where one effect is not enough.
        begun: fits from the calibrated simulator to a set of effects that the search begins with, too.
        settled: it begins with these alone.
    """
    base = base or search.base()
    grown = _grow(search, begun if settled else (base,), leader=() if settled else begun)
    if len(begun) > 1 and not settled:
        search.report(f"beginning with {' and '.join(search.terms[t].label for t in begun[-1].terms)}")
        again = _grow(search, begun)
        again = again._replace(stages=(*grown.stages[:1], *again.stages))
        grown = _whole(search, max(grown, again, key=lambda g: worth(g.path[-1])))
    several = len(grown.path) > 2 or grown.remainder
    if beginnings and several and not search.budget.over("searches that begin with another effect"):
        others = _otherwise(search, grown, beginnings)
        grown = _whole(search, max([grown, *others], key=lambda g: worth(g.path[-1])))
    found = _ended(search, _paired(search, grown))
    # what is not needed any more may have hidden another one
    if settled and len(found.chosen.terms) < len(begun[-1].terms):
        again = _grow(search, found.path)
        found = _ended(search, _paired(search, again._replace(stages=(*found.stages, *again.stages))))
    return found


def further(search: Search, found: Selection) -> Selection:
    """Go on from what is left of a selection whose lost effects are candidates no more: another may take their place.

    One effect in place of two is not asked yet.
    """
    grown = _grow(search, found.path)
    stages = found.stages + grown.stages
    risen = grown.path[-1].optimum.log_evidence - found.chosen.optimum.log_evidence
    if grown.path[-1].terms == found.chosen.terms and risen < ASTRAY:
        return found._replace(stages=stages, remainder=found.remainder or grown.remainder)
    return _ended(search, grown._replace(stages=stages))


def widely(search: Search, found: Selection) -> Selection:
    """Search once more with effects that begin anywhere in their ranges: one of them first, or beside what was chosen."""
    if search.budget.over("effects that begin anywhere in their ranges"):
        return found
    search.report("beginning anywhere in the ranges of effects")
    others = [_grow(search, found.path[:1], widely=True)]
    if found.chosen.terms:
        beside = _grow(search, found.path, widely=True)
        others.append(beside._replace(stages=(*found.stages[:-1], *beside.stages)))  # the last one found nothing more
    best = max(others, key=lambda g: worth(g.path[-1]))
    return found if worth(best.path[-1]) < worth(found.chosen) + ASTRAY else _ended(search, best)


def _paired(search: Search, grown: _Grown) -> _Grown:
    """Go on with two effects at once where none pays alone, as long as that pays."""
    while len(grown.path[-1].terms) + 2 <= MOST_EFFECTS and not search.budget.over("effects that pay only together"):
        both = together(search, grown.path[-1])
        if both is None:
            break
        risen = both.optimum.log_evidence - grown.path[-1].optimum.log_evidence
        search.report(f"{' and '.join(search.terms[t].label for t in both.terms[-2:])} +{risen:.0f} together")
        again = _grow(search, path_of(search, both))
        grown = again._replace(stages=(*grown.stages, *again.stages))
    return grown


def condensed(search: Search, found: Selection) -> Selection:
    """Put one term in the place of two chosen ones where one will do, and go on from there.

    With many effects it takes longer than what came before: it is asked once it is known that the ranges are right.
    """
    for merger in range(MOST_MERGERS + 1):
        stage = merged(search, found.chosen)
        if stage is None:
            break
        whole = stage.trials[0]
        if nameless(search, whole):
            return found._replace(instead=whole)
        if merger == MOST_MERGERS:
            break
        search.report(f"{search.terms[whole.terms[-1]].label} in place of two")
        again = _grow(search, path_of(search, whole))
        found = _ended(search, again._replace(stages=(*found.stages, stage, *again.stages)))
    return found


def _ended(search: Search, grown: _Grown) -> Selection:
    """Drop what is not needed in the end."""
    grown, chosen, gains = _pruned(search, grown)
    path = path_of(search, chosen)
    return Selection(path[0], chosen, path, (), grown.stages, gains, grown.remainder)


def _pruned(search: Search, grown: _Grown) -> tuple[_Grown, Trial, tuple[float, ...]]:
    """Drop what is not needed in the end; return it with what each effect adds.

    What an effect seemed to add may be a better fit of the smaller model, which the effect led to: then the search grew from
    the wrong place, and grows once more.
    """
    while True:
        chosen, gains, _ = search.prune(grown.path[-1])
        first = next((t for t in grown.path[:-1] if set(t.terms) == set(chosen.terms)), None)
        if first is None or not chosen.optimum.log_evidence > first.optimum.log_evidence + ASTRAY:
            return grown, chosen, gains
        search.report(
            f"without what was added it fits {chosen.optimum.log_evidence - first.optimum.log_evidence:.0f} nats better"
        )
        again = _grow(search, path_of(search, chosen))
        led = (stage for stage in grown.stages if len(stage.before.terms) < len(chosen.terms))
        grown = again._replace(stages=(*led, *again.stages))


def _grow(search: Search, path: tuple[Trial, ...], *, widely: bool = False, leader: tuple[Trial, ...] = ()) -> _Grown:
    """Add one effect after another to the end of a path, as long as they earn their place.

    Args:
        search: over sets of effects.
        path: to begin with.
        widely: the first one, and one at the end, may begin anywhere in its ranges.
        leader: the best path so far: one that falls behind it, or comes to the same effects, goes no further; nor does one that
            has come to a part of them, where what promises by far most beside these is the leader's, too.
    """
    stages: list[Stage] = []
    wide, behind = widely, 0
    remainder = None
    while True:
        current = path[-1]
        if current.terms and search.budget.over("effects beside those found"):
            return _Grown(path, tuple(stages), None)
        stage = search.add(current, search.candidates(current.terms), widely=wide)
        trials = stage.trials
        if trials and trials[0].optimum.log_evidence - current.optimum.log_evidence > GUARD:
            again = search.fitter(
                [
                    Hypothesis(search.off(t.optimum.z, t.terms[-1:]), search.free(current.terms), search.ones)
                    for t in trials[:4]
                ]
            )
            better = search.best(current.terms, again)
            if better.optimum.log_evidence > current.optimum.log_evidence + 1:
                path = (*path[:-1], better)
                continue
        stages.append(stage)
        least = asked(len(current.terms) + 1)
        best = search.best_named(trials, current.optimum.log_evidence + least)
        unnamed = next((t for t in trials if search.terms[t.terms[-1]].depends_on), None)
        gain, gain_unnamed = (
            t.optimum.log_evidence - current.optimum.log_evidence if t else -np.inf for t in (best, unnamed)
        )
        if best is None or not gain > least or len(current.terms) == MOST_EFFECTS:
            if widely and not wide and len(current.terms) < MOST_EFFECTS:
                wide = True
                stages.pop()  # of the same candidates: they are tried again, from more places
                continue
            if unnamed is not None and gain_unnamed > ACCEPT:
                remainder = (search.terms[unnamed.terms[-1]], float(gain_unnamed))
            return _Grown(path, tuple(stages), remainder)
        path, wide = (*path, best), False
        search.report(f"{search.terms[best.terms[-1]].label} +{gain:.0f}")
        if 1 < len(best.terms) < len(leader):
            there = leader[len(best.terms)]
            behind = behind + 1 if worth(best) < worth(there) else 0
            alike = set(best.terms) == set(there.terms) and worth(best) <= worth(there) + ASTRAY
            if behind == MOST_BEHIND or alike or _follows(search, best, leader):
                return _Grown(path, tuple(stages), None, cut=True)


def _whole(search: Search, grown: _Grown) -> _Grown:
    """Go on with a path that was cut for another one and is worth more: what led may hold effects that earn nothing."""
    if not grown.cut:
        return grown
    more = _grow(search, grown.path)
    return more._replace(stages=(*grown.stages, *more.stages))


def _follows(search: Search, trial: Trial, leader: tuple[Trial, ...]) -> bool:
    """Whether a model has a part of the best one's effects, the rest of which promise far more beside it than what it lacks.

    Not if it is ahead of the best path with as many. What cannot be told is left to the best path, which has tried it.
    """
    ahead = set(leader[-1].terms)
    if not set(trial.terms) < ahead or worth(trial) > worth(leader[len(trial.terms)]) + ASTRAY:
        return False
    own, others = 0.0, 0.0
    for t, _, score in search.promised(trial, search.candidates(trial.terms)):
        if t in ahead:
            own = max(own, score.sure)
        elif not search.terms[t].depends_on:
            others = max(others, score.sure)
    return FAR_MORE * others < own


def _otherwise(search: Search, grown: _Grown, most: int) -> Iterator[_Grown]:
    """Yield where the search ends that begins with another effect.

    What first explains most is not always there: it may stand for a part of two others.
    """
    first, begun = grown.stages[0], grown.path[1:2]
    least = first.before.optimum.log_evidence + ACCEPT
    others = [t for t in first.trials if not nameless(search, t) and not any(_holds(search, t, b) for b in begun)]
    runners_up = [(t, _best_next_gain(search, t)) for t in others[:MOST_RUNNERS_UP] if t.optimum.log_evidence > least]
    seen = [(t.optimum.log_evidence, _best_next_gain(search, t)) for t in begun]
    tried = 0
    for trial, next_gain in sorted(runners_up, key=lambda found: -found[0].optimum.log_evidence - found[1]):
        here = trial.optimum.log_evidence, next_gain
        if tried == most or any(np.allclose(here, there, rtol=0, atol=TIE / 2) for there in seen):
            continue
        seen.append(here)
        tried += 1
        search.report(f"beginning with {search.terms[trial.terms[-1]].label}")
        other = _grow(search, (grown.path[0], trial), leader=grown.path)
        yield other._replace(stages=(first, *other.stages))


def _holds(search: Search, trial: Trial, begun: Trial) -> bool:
    """Whether the newest effect of a trial is that of another, or a more general one at the same place."""
    term, own = (search.terms[t.terms[-1]] for t in (trial, begun))
    return trial.terms == begun.terms or (own.effect in term.generalises and own.acts_on == term.acts_on)


def _best_next_gain(search: Search, trial: Trial) -> float:
    """Return what the best next effect promises beside a trial's, nats."""
    named = [t for t in search.candidates(trial.terms) if not search.terms[t].depends_on]
    return max([0.0, *(score.sure for score in search.promises(trial, search.starts(trial, named)))])
