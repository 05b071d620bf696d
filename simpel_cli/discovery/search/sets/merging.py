"""One effect in place of two."""

from itertools import combinations

import numpy as np

from simpel_cli.discovery.search.score_test import has_size
from simpel_cli.discovery.search.sets.selection import nameless, worth
from simpel_cli.discovery.search.trials import ACCEPT, SHARE, Search, Stage, Trial, asked
from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simpel_cli.filtering.race import MARGIN, hopeful
from simpel_cli.filtering.setup import key_of
from simulators.effects.term import INPUT, OPERATORS, SENSOR

SLACK = 10.0  # nats by which the widths of priors may differ
PER_UNKNOWN = 4.0  # nats that an unknown less is worth, as one that the data know a hundred times better than its range
MOST_OF_IT = 0.4  # of what two effects explain, to first order: a term in their place may have to find its shape
SIGNALS = (*OPERATORS, SENSOR, INPUT)


def merged(search: Search, chosen: Trial) -> Stage | None:
    """Return the model without two of the chosen effects and, first of its trials, one term that does as well as both.

    An input that arrives late makes two sensors seem late, and one function of the input two faults of it. None: there is
    no such term.
    """
    called = {pair: frozenset(key_of(search.terms[t]) for t in pair) for pair in combinations(chosen.terms, 2)}
    pairs = [pair for pair, name in called.items() if name not in search.together]
    if not pairs or search.budget.over("one effect in place of two"):
        return None
    question = "merged", chosen.terms, chosen.optimum.z.tobytes(), frozenset(search.banned)
    stage = search.once(question, lambda: _merged(search, chosen, pairs))
    if stage is None:
        search.together.update(called.values())
    return stage


def _merged(search: Search, chosen: Trial, pairs: list[tuple[int, int]]) -> Stage | None:
    alike = {pair: own for pair in pairs if (own := _alike(search, chosen, pair))}
    # from the chosen model and its noise: those go on that may come as far as an effect less has to
    begun = [
        (terms, hypothesis)
        for pair, own in alike.items()
        for terms in [(*(t for t in chosen.terms if t not in pair), new) for new in own]
        for hypothesis in search.hypotheses(terms, terms[-1], search.off(chosen.optimum.z, pair))
    ]

    def needed(fit: Optimum) -> float:
        fewer = len(chosen.optimum.free) - len(fit.free)
        return chosen.optimum.loss + asked(len(chosen.terms)) + SLACK + PER_UNKNOWN * max(fewer, 0)

    fits = search.fitter(
        [hypothesis for _, hypothesis in begun], hopes=lambda optima: hopeful(optima, [needed(o) for o in optima])
    )

    def came(fit: Optimum) -> bool:
        return not fit.left and fit.loss <= needed(fit) + MARGIN

    reached = dict.fromkeys(terms for (terms, _), fit in zip(begun, fits, strict=True) if came(fit))
    for (terms, _), fit in zip(begun, fits, strict=True):
        if came(fit):
            search.best(terms, [fit])
    most, found = worth(chosen), None
    for less in dict.fromkeys(terms[:-1] for terms in reached):
        rest = search.part(chosen, less)
        stage = search.add(rest, [terms[-1] for terms in reached if terms[:-1] == less])
        known = {t.terms for t in stage.trials} | {terms for terms in reached if terms[:-1] == less}
        trials = sorted((search.best(terms, ()) for terms in known), key=lambda t: -t.optimum.log_evidence)
        stage, named = stage._replace(trials=tuple(trials)), search.best_named(trials)
        for trial in [*([named] if named else []), *(t for t in trials[:1] if nameless(search, t))]:
            value = worth(trial) - (ACCEPT if nameless(search, trial) else 0.0)
            if value > most:
                others = [t for t in stage.trials if t is not trial]
                most, found = value, stage._replace(trials=(trial, *others))
    return found


def _alike(search: Search, chosen: Trial, pair: tuple[int, int]) -> list[int]:
    """Return the terms that point where a pair of effects points, before anything is fitted.

    Where both are switched off and nothing else has moved, what is left is what they explain. A term in their place has to
    explain most of that, to first order, with the noise of the chosen model. What has no size is asked only where
    it may stand for two effects of signals, of which it shares a channel or through which it acts.
    """
    rest = Trial(tuple(t for t in chosen.terms if t not in pair), chosen.optimum)
    off = rest._replace(optimum=chosen.optimum._replace(z=search.off(chosen.optimum.z, pair)))
    candidates = [t for t in search.candidates(rest.terms) if t not in pair]
    own = [(t, Hypothesis(chosen.optimum.z, search.free(chosen.terms), search.ones)) for t in pair]
    sized = [s for s in search.starts(off, candidates) if has_size(search.plan, *s)]
    late = [t for t in candidates if _through(search, t, pair)]
    starts = [*own, *sized, *(s for s in search.starts(off, late) if not has_size(search.plan, *s))]
    sets = [(0, 1), *((i,) for i in range(2, len(starts)))]
    both, *each = search.promises(off, starts, sets)
    if np.isfinite(both.gain):
        least = MOST_OF_IT * both.gain
    else:
        parts = (search.part(chosen, tuple(t for t in chosen.terms if t != gone)) for gone in pair)
        least = SHARE * max(chosen.optimum.log_evidence - part.optimum.log_evidence for part in parts)
    return list(dict.fromkeys(
        t for (t, _), score in zip(starts[2:], each, strict=True)
        if score.gain > least  # also where that cannot be told
    ))  # fmt: skip


def _through(search: Search, term: int, pair: tuple[int, int]) -> bool:
    """Whether a late signal may stand for a pair: both are of signals, and it is an input's or on a channel of theirs."""
    new, *others = (search.terms[t] for t in (term, *pair))
    if not all(other.kind in SIGNALS for other in others):
        return False
    ends = {other.acts_on for other in others}
    inputs = {q.name for q in search.plan.augmented.model.inputs}
    return new.acts_on in ends | inputs or ends <= inputs
