"""A set of effects that was chosen, and what is left of it without some of them."""

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.trials import ACCEPT, Search, Stage, Trial, asked
from simulators.effects import Term


class Selection(NamedTuple):
    """What the search found.

    Args:
        base: the simulator as it is, calibrated.
        chosen: with the effects that earned their place.
        path: fits after each accepted effect, from `base` on.
        classes: per chosen term, trials that do as well with another name in its place; none: not asked yet.
        stages: all that was tried; the last one found nothing more.
        gains: evidence that each chosen term adds to the rest.
        remainder: an unnamed function that the data still ask for, and its gain.
        instead: a function without a name that does better than two of the chosen terms in their place.
    """

    base: Trial
    chosen: Trial
    path: tuple[Trial, ...]
    classes: tuple[tuple[Trial, ...], ...]
    stages: tuple[Stage, ...]
    gains: tuple[float, ...]
    remainder: tuple[Term, float] | None
    instead: Trial | None = None


def worth(trial: Trial) -> float:
    """Return the evidence of a model less what its effects have to earn, nats."""
    return trial.optimum.log_evidence - sum(asked(k + 1) for k in range(len(trial.terms)))


def nameless(search: Search, trial: Trial) -> bool:
    """Whether the newest term of a trial is a function without a name."""
    return bool(search.terms[trial.terms[-1]].depends_on)


def beaten(search: Search, found: Selection) -> bool:
    """Whether a function without a name did better than the named effect that a step of the search took."""
    chosen = set(found.chosen.terms)
    for stage in found.stages:
        evidence = {
            unnamed: max(
                (t.optimum.log_evidence for t in stage.trials if nameless(search, t) == unnamed), default=-np.inf
            )
            for unnamed in (True, False)
        }
        if chosen > set(stage.before.terms) and evidence[True] >= evidence[False] + ACCEPT:
            return True
    return False


def path_of(search: Search, chosen: Trial) -> tuple[Trial, ...]:
    """Return the best fits from the simulator alone to a set of effects, one effect more at a time."""
    return tuple(search.part(chosen, chosen.terms[:k]) for k in range(len(chosen.terms) + 1))


def steps(search: Search, found: Selection) -> tuple[Stage, ...]:
    """Return the stages of a selection, and before them the steps to where a search began that another one was made before."""
    begun = found.stages[0].before if found.stages else found.chosen
    path = path_of(search, begun)
    return (*(Stage(before, (after,)) for before, after in pairwise(path)), *found.stages)


def cut(search: Search, found: Selection, kept: Sequence[int]) -> Selection:
    """Return what is left of a selection of which only the chosen effects at these places are kept."""
    rest = tuple(found.chosen.terms[i] for i in kept)
    chosen = search.best(rest, search.fitter(search.less(found.chosen, rest)))
    path = path_of(search, chosen)
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
    """Return a selection without effect i, which held-out episodes refused."""
    left, _ = weeded(search, found, [j for j in range(len(found.chosen.terms)) if j != i])
    known = [search.terms.index(found.remainder[0])] if found.remainder else []
    gains = asked_for(search, left.chosen, known)
    remainder = next(((search.terms[t], float(gain)) for t, gain in gains.items() if gain > ACCEPT), None)
    return left._replace(remainder=remainder, classes=(), instead=None)


def asked_for(search: Search, chosen: Trial, functions: Collection[int]) -> dict[int, float]:
    """Return what functions without a name earn beside a model, as far as the program has room, nats."""
    here = [t for t in functions if search.fits((*chosen.terms, t))]
    trials = search.add(chosen, here).trials if here else ()
    return {t.terms[-1]: t.optimum.log_evidence - chosen.optimum.log_evidence for t in trials}
