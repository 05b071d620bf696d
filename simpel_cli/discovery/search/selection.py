"""Which effects the model lacks: forward and backward selection by evidence.

A named effect has to beat every other name and every function without one; names that do as well form a class. Two effects
have to beat every single term in place of both.
"""

from collections.abc import Collection, Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.pairs import together
from simpel_cli.discovery.search.trials import ACCEPT, ASTRAY, SHARE, TIE, Search, Stage, Trial, asked
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simulators.effects import Term
from simulators.effects.term import INPUT, OPERATORS, SENSOR

MOST_EFFECTS = 8
MOST_MERGERS = 2
MOST_AGAIN = 3
MOST_RUNNERS_UP = 8  # effects that a search could begin with
BEGINNINGS = 2  # that it does begin with, beside the one that explains most
MOST = 0.9  # of what a function without a name explains: a formula that explains so much of it stays
GUARD = 1000.0  # nats: so large a gain says that the smaller model had not found its optimum


class Selection(NamedTuple):
    """What the search found.

    Args:
        base: the simulator as it is, calibrated.
        chosen: with the effects that earned their place.
        path: fits after each accepted effect, from `base` on.
        classes: per chosen term, trials that do as well with another name in its place.
        stages: all that was tried; the last one found nothing more.
        gains: evidence that each chosen term adds to the rest.
        remainder: an unnamed function that the data still ask for, and its gain.
    """

    base: Trial
    chosen: Trial
    path: tuple[Trial, ...]
    classes: tuple[tuple[Trial, ...], ...]
    stages: tuple[Stage, ...]
    gains: tuple[float, ...]
    remainder: tuple[Term, float] | None


class _Grown(NamedTuple):
    """Where adding effects ended: the fits on the way, what was tried, and an unnamed function still asked for."""

    path: tuple[Trial, ...]
    stages: tuple[Stage, ...]
    remainder: tuple[Term, float] | None


def select(
    search: Search, base: Trial | None = None, beginnings: int = BEGINNINGS, begun: tuple[Trial, ...] = ()
) -> Selection:
    """Search, from the calibrated simulator if it is known already.

    Args:
        search: over the sets of effects of one setup.
        base: its calibrated simulator.
        beginnings: first effects that are tried beside the one that explains most, where one effect is not enough.
        begun: fits from the calibrated simulator to a set of effects that the search begins with, too.
    """
    base = base or search.base()
    grown = _grow(search, (base,))
    if len(begun) > 1:
        search.report(f"beginning with {' and '.join(search.terms[t].label for t in begun[-1].terms)}")
        grown = max(grown, _grow(search, begun), key=lambda g: worth(g.path[-1]))
    several = len(grown.path) > 2 or grown.remainder
    if beginnings and several and not search.budget.over("searches that begin with another effect"):
        grown = max([grown, *_otherwise(search, grown, beginnings)], key=lambda g: worth(g.path[-1]))
    return _settled(search, _paired(search, grown))


def further(search: Search, found: Selection) -> Selection:
    """Go on from what is left of a selection whose lost effects are candidates no more: another may take their place."""
    grown = _grow(search, found.path)
    stages = found.stages + grown.stages
    risen = grown.path[-1].optimum.log_evidence - found.chosen.optimum.log_evidence
    if grown.path[-1].terms == found.chosen.terms and risen < ASTRAY:
        return found._replace(stages=stages, remainder=found.remainder or grown.remainder)
    return _settled(search, grown._replace(stages=stages))


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
    return found if worth(best.path[-1]) < worth(found.chosen) + ASTRAY else _settled(search, best)


def _paired(search: Search, grown: _Grown) -> _Grown:
    """Go on with two effects at once where none pays alone, as long as that pays."""
    while len(grown.path[-1].terms) + 2 <= MOST_EFFECTS and not search.budget.over("effects that pay only together"):
        both = together(search, grown.path[-1])
        if both is None:
            break
        risen = both.optimum.log_evidence - grown.path[-1].optimum.log_evidence
        search.report(f"{' and '.join(search.terms[t].label for t in both.terms[-2:])} +{risen:.0f} together")
        again = _grow(search, _path(search, both))
        grown = again._replace(stages=(*grown.stages, *again.stages))
    return grown


def _settled(search: Search, grown: _Grown) -> Selection:
    """Drop what is not needed in the end, put one term in the place of two where one will do, and name the rivals."""
    for merger in range(MOST_MERGERS + 1):
        grown, chosen, gains, without = _pruned(search, grown)
        stage = _merged(search, chosen)
        if stage is None or _nameless(search, stage.trials[0]) or merger == MOST_MERGERS:
            break
        whole = stage.trials[0]
        search.report(f"{search.terms[whole.terms[-1]].label} in place of two")
        again = _grow(search, _path(search, whole))
        grown = again._replace(stages=(*grown.stages, stage, *again.stages))
    path = _path(search, chosen)
    found = Selection(path[0], chosen, path, (), grown.stages, gains, grown.remainder)
    instead = stage.trials[0] if stage is not None and _nameless(search, stage.trials[0]) else None
    return _against(search, found, without, instead)


def _pruned(search: Search, grown: _Grown) -> tuple[_Grown, Trial, tuple[float, ...], list[Trial]]:
    """Drop what is not needed in the end; return it with what each effect adds, and the rest without it.

    What an effect seemed to add may be a better fit of the smaller model, which the effect led to: then the search grew from
    the wrong place, and grows once more.
    """
    while True:
        chosen, gains, without = search.prune(grown.path[-1])
        first = next((t for t in grown.path[:-1] if set(t.terms) == set(chosen.terms)), None)
        if first is None or not chosen.optimum.log_evidence > first.optimum.log_evidence + ASTRAY:
            return grown, chosen, gains, without
        search.report(
            f"without what was added it fits {chosen.optimum.log_evidence - first.optimum.log_evidence:.0f} nats better"
        )
        again = _grow(search, _path(search, chosen))
        led = (stage for stage in grown.stages if len(stage.before.terms) < len(chosen.terms))
        grown = again._replace(stages=(*led, *again.stages))


def worth(trial: Trial) -> float:
    """Return the evidence of a model less what its effects have to earn, nats."""
    return trial.optimum.log_evidence - sum(asked(k + 1) for k in range(len(trial.terms)))


def _nameless(search: Search, trial: Trial) -> bool:
    """Whether the newest term of a trial is a function without a name."""
    return bool(search.terms[trial.terms[-1]].depends_on)


def _grow(search: Search, path: tuple[Trial, ...], *, widely: bool = False) -> _Grown:
    """Add one effect after another to the end of a path, as long as they earn their place.

    Args:
        search: over sets of effects.
        path: to begin with.
        widely: the first one, and one at the end, may begin anywhere in its ranges.
    """
    stages: list[Stage] = []
    wide = widely
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


def _otherwise(search: Search, grown: _Grown, most: int) -> Iterator[_Grown]:
    """Yield where the search ends that begins with another effect.

    What first explains most is not always there: it may stand for a part of two others.
    """
    first, begun = grown.stages[0], grown.path[1:2]
    least = first.before.optimum.log_evidence + ACCEPT
    others = [t for t in first.trials if not _nameless(search, t) and not any(_holds(search, t, b) for b in begun)]
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
        other = _grow(search, (grown.path[0], trial))
        yield other._replace(stages=(first, *other.stages))


def _holds(search: Search, trial: Trial, begun: Trial) -> bool:
    """Whether the newest effect of a trial is that of another, or a more general one at the same place."""
    term, own = (search.terms[t.terms[-1]] for t in (trial, begun))
    return trial.terms == begun.terms or (own.effect in term.generalises and own.acts_on == term.acts_on)


def _best_next_gain(search: Search, trial: Trial) -> float:
    """Return what the best next effect promises beside a trial's, nats."""
    named = [t for t in search.candidates(trial.terms) if not search.terms[t].depends_on]
    gains = [score.gain for score in search.promises(trial, search.starts(trial, named))]
    return max((g for g in gains if np.isfinite(g)), default=0.0)


def _merged(search: Search, chosen: Trial) -> Stage | None:
    """Return the model without two of the chosen effects and, first of its trials, one term that does as well as both.

    An input that arrives late makes two sensors seem late, and one function of the input two faults of it. None: there is
    no such term.
    """
    most, found = worth(chosen), None
    pairs = list(combinations(chosen.terms, 2))
    if pairs and search.budget.over("one effect in place of two"):
        return None
    sets = [tuple(t for t in chosen.terms if t not in pair) for pair in pairs]
    fits = search.fitter([hypothesis for less in sets for hypothesis in search.less(chosen, less)])
    for k, (pair, less) in enumerate(zip(pairs, sets, strict=True)):
        rest = search.best(less, fits[2 * k : 2 * k + 2])
        promising = _in_place_of(search, chosen, pair, rest)
        if not promising:
            continue
        stage = search.add(rest, promising)
        # with two terms less the noise may have settled elsewhere: the best begin once more with that of the chosen model
        z = search.off(chosen.optimum.z, pair)
        again = [t for t in stage.trials if not _nameless(search, t)][:MOST_AGAIN]
        hypotheses = [(t.terms, hypothesis) for t in again for hypothesis in search.hypotheses(t.terms, t.terms[-1], z)]
        for (terms, _), optimum in zip(
            hypotheses, search.fitter([hypothesis for _, hypothesis in hypotheses]), strict=True
        ):
            search.best(terms, [optimum])
        trials = sorted((search.best(t.terms, ()) for t in stage.trials), key=lambda t: -t.optimum.log_evidence)
        stage, named = stage._replace(trials=tuple(trials)), search.best_named(trials)
        for trial in [*([named] if named else []), *(t for t in trials[:1] if _nameless(search, t))]:
            value = worth(trial) - (ACCEPT if _nameless(search, trial) else 0.0)
            if value > most:
                others = [t for t in stage.trials if t is not trial]
                most, found = value, stage._replace(trials=(trial, *others))
    return found


def _in_place_of(search: Search, chosen: Trial, pair: tuple[int, ...], rest: Trial) -> list[int]:
    """Return the terms that may do as well as a pair of effects: they promise a share of what is needed beside the rest.

    Of a late signal a slope cannot tell. It can only stand for effects of which one is of a signal, too.
    """
    candidates = [t for t in search.candidates(rest.terms) if t not in pair]
    signals = any(search.terms[t].kind in (*OPERATORS, SENSOR, INPUT) for t in pair)
    needed = SHARE * (chosen.optimum.log_evidence - asked(len(chosen.terms)) - rest.optimum.log_evidence)
    starts = search.starts(rest, candidates)
    return list(dict.fromkeys(
        t for (t, _), score in zip(starts, search.promises(rest, starts), strict=True)
        if score.gain > needed and (np.isfinite(score.gain) or signals or search.terms[t].kind not in OPERATORS)
    ))  # fmt: skip


def _path(search: Search, chosen: Trial) -> tuple[Trial, ...]:
    """Return the best fits from the simulator alone to a set of effects, one effect more at a time."""
    return tuple(search.part(chosen, chosen.terms[:k]) for k in range(len(chosen.terms) + 1))


def _against(search: Search, found: Selection, without: Sequence[Trial], instead: Trial | None = None) -> Selection:
    """Take out, one at a time, the effects that a function without a name makes superfluous; name the rivals of the rest.

    Args:
        search: over sets of effects.
        found: what was chosen.
        without: per chosen effect, the model that lacks it.
        instead: a model with a function without a name in place of two of them, that does better; None: there is none.
    """
    left = {search.terms.index(found.remainder[0]): found.remainder[1]} if found.remainder else {}
    while True:
        chosen, classes = found.chosen, list[tuple[Trial, ...]]()
        superfluous: dict[int, int] = {}
        for i, rest in enumerate(without):
            rivals = search.rivals(chosen, rest)
            classes.append(tuple(t for t in rivals if not _nameless(search, t)))
            beaten = next((t for t in rivals if _nameless(search, t)), None)
            if instead is not None and chosen.terms[i] not in instead.terms:
                beaten = instead
            whole = None if beaten is None else _beside(search, chosen, i, beaten, rest)
            if whole is not None:
                left[whole.terms[-1]] = whole.optimum.log_evidence - chosen.optimum.log_evidence
            elif beaten is not None:
                superfluous[i] = beaten.terms[-1]
        if not superfluous:
            break
        gone = min(superfluous, key=lambda i: found.gains[i])
        found, without = weeded(search, found, [i for i in range(len(chosen.terms)) if i != gone])
        left, instead = _asked_for(search, found.chosen, {superfluous[gone], *left}), None
    most = max(left, key=lambda t: left[t], default=None)
    remainder = None if most is None or left[most] <= ACCEPT else (search.terms[most], float(left[most]))
    return found._replace(classes=tuple(classes), remainder=remainder)


def _asked_for(search: Search, chosen: Trial, functions: Collection[int]) -> dict[int, float]:
    """Return what functions without a name earn beside a model, as far as the program has room, nats."""
    here = [t for t in functions if search.fits((*chosen.terms, t))]
    trials = search.add(chosen, here).trials if here else ()
    return {t.terms[-1]: t.optimum.log_evidence - chosen.optimum.log_evidence for t in trials}


def _beside(search: Search, chosen: Trial, i: int, rival: Trial, without: Trial) -> Trial | None:
    """Return the chosen model and a function without a name, unless that makes effect i superfluous.

    A real friction is no formula: some function does better, and a formula may still be most of it: where it earns beside the
    function, or `MOST` of what the function earns in its place. Where the program has no room for both, the formula stays.
    """
    function, own = rival.terms[-1], chosen.terms[i]
    what, depends_on = search.terms[own].label, " and ".join(search.terms[function].depends_on)
    if not search.fits((*chosen.terms, function)):
        search.report(f"{what}: a function of {depends_on} does better; no room for both (discovery.room)")
        return rival
    terms = (*chosen.terms, function)
    starts = []
    for z, new, other in ((chosen.optimum.z, function, rival), (rival.optimum.z, own, chosen)):
        z = search.loud(z)
        rows = search.all_rows(new)
        z[rows] = other.optimum.z[rows]
        starts.append(Hypothesis(z, search.free(terms), search.ones))
    whole = search.best(terms, search.fitter(starts))
    rest = (*(t for t in chosen.terms if t != own), function)
    part = search.best(rest, search.fitter(search.less(whole, rest)))
    earned = whole.optimum.log_evidence - part.optimum.log_evidence
    own_gain, its_gain = (t.optimum.log_evidence - without.optimum.log_evidence for t in (chosen, rival))
    stays = earned >= asked(len(chosen.terms)) or own_gain >= MOST * its_gain
    search.report(
        f"{what} +{own_gain:.0f}: a function of {depends_on} does better, +{its_gain:.0f}"
        f"{f'; beside it +{earned:.0f}' if stays else ''}"
    )
    return whole if stays else None


def cut(search: Search, found: Selection, kept: Sequence[int]) -> Selection:
    """Return what is left of a selection of which only the chosen effects at these places are kept."""
    rest = tuple(found.chosen.terms[i] for i in kept)
    chosen = search.best(rest, search.fitter(search.less(found.chosen, rest)))
    path = _path(search, chosen)
    return found._replace(
        base=path[0],
        chosen=chosen,
        path=path,
        classes=tuple(found.classes[i] for i in kept) if found.classes else (),
        gains=tuple(found.gains[i] for i in kept),
    )


def weeded(search: Search, found: Selection, kept: Sequence[int]) -> tuple[Selection, tuple[Trial, ...]]:
    """Return the same without those that do not earn their place any more, and, per effect, the model that lacks it."""
    left = cut(search, found, kept)
    chosen, gains, without = search.prune(left.chosen)
    left = cut(search, left, [i for i, t in enumerate(left.chosen.terms) if t in chosen.terms])
    return left._replace(gains=gains), tuple(without)


def refused(search: Search, found: Selection, i: int) -> Selection:
    """Return a selection without effect i, which held-out episodes refused; with it, others are rivals than without it."""
    left, without = weeded(search, found, [j for j in range(len(found.chosen.terms)) if j != i])
    known = [search.terms.index(found.remainder[0])] if found.remainder else []
    gains = _asked_for(search, left.chosen, known)
    remainder = next(((search.terms[t], float(gain)) for t, gain in gains.items() if gain > ACCEPT), None)
    return _against(search, left._replace(remainder=remainder), without)
