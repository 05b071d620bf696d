"""One effect in place of two."""

from itertools import combinations

import numpy as np

from simpel_cli.discovery.search.sets.selection import nameless, worth
from simpel_cli.discovery.search.trials import ACCEPT, SHARE, Search, Stage, Trial, asked
from simulators.effects.term import INPUT, OPERATORS, SENSOR

MOST_AGAIN = 3
NEARLY_ALL = 0.7  # of what two effects explain: a fit that came to less in their place need not be made again


def merged(search: Search, chosen: Trial) -> Stage | None:
    """Return the model without two of the chosen effects and, first of its trials, one term that does as well as both.

    An input that arrives late makes two sensors seem late, and one function of the input two faults of it. None: there is
    no such term.
    """
    pairs = list(combinations(chosen.terms, 2))
    if not pairs or search.budget.over("one effect in place of two"):
        return None
    question = "merged", chosen.terms, chosen.optimum.z.tobytes(), frozenset(search.banned)
    return search.once(question, lambda: _merged(search, chosen, pairs))


def _merged(search: Search, chosen: Trial, pairs: list[tuple[int, int]]) -> Stage | None:
    most, found = worth(chosen), None
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
        again = [t for t in stage.trials if not nameless(search, t)][:MOST_AGAIN]
        hypotheses = [(t.terms, hypothesis) for t in again for hypothesis in search.hypotheses(t.terms, t.terms[-1], z)]
        for (terms, _), optimum in zip(
            hypotheses, search.fitter([hypothesis for _, hypothesis in hypotheses]), strict=True
        ):
            search.best(terms, [optimum])
        trials = sorted((search.best(t.terms, ()) for t in stage.trials), key=lambda t: -t.optimum.log_evidence)
        stage, named = stage._replace(trials=tuple(trials)), search.best_named(trials)
        for trial in [*([named] if named else []), *(t for t in trials[:1] if nameless(search, t))]:
            value = worth(trial) - (ACCEPT if nameless(search, trial) else 0.0)
            if value > most:
                others = [t for t in stage.trials if t is not trial]
                most, found = value, stage._replace(trials=(trial, *others))
    return found


def _in_place_of(search: Search, chosen: Trial, pair: tuple[int, ...], rest: Trial) -> list[int]:
    """Return the terms that may do as well as a pair of effects: they promise a share of what is needed beside the rest.

    Of a late signal a slope cannot tell. It can only stand for effects of which one is of a signal, too. What was fitted beside
    the rest already, and came to much less, is left.
    """
    whole = chosen.optimum.log_evidence - asked(len(chosen.terms)) - rest.optimum.log_evidence

    def fell_short(term: int) -> bool:
        known = search.known.get(frozenset((*rest.terms, term)))
        return known is not None and known.log_evidence - rest.optimum.log_evidence < NEARLY_ALL * whole

    candidates = [t for t in search.candidates(rest.terms) if t not in pair and not fell_short(t)]
    signals = any(search.terms[t].kind in (*OPERATORS, SENSOR, INPUT) for t in pair)
    starts = search.starts(rest, candidates)
    return list(dict.fromkeys(
        t for (t, _), score in zip(starts, search.promises(rest, starts), strict=True)
        if score.gain > SHARE * whole and (np.isfinite(score.gain) or signals or search.terms[t].kind not in OPERATORS)
    ))  # fmt: skip
