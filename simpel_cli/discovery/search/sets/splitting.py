"""Two effects in place of one that holds one of them.

Dry friction that differs between the directions is Coulomb friction beside a constant load, but for the lowest speeds. Neither
name is wrong where the data show little of those, and one effect is the shorter answer: the pairs are said beside it.
"""

from simpel_cli.discovery.search.trials import SAME, TIE, Search, Trial
from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simulators.effects import Term

MOST_OF_IT = (
    0.4  # of what an effect explains beyond its special case, to first order: so much another one has to promise
)
FITTED = 4  # pairs


def two_in_place(search: Search, chosen: Trial, place: int) -> list[tuple[Term, Term]]:
    """Return the pairs that fit as well as one chosen effect: a special case of it where it acts, and another effect.

    Args:
        search: over sets of effects.
        chosen: the model.
        place: of the effect in it.
    """
    own = chosen.terms[place]
    term, rest = search.terms[own], tuple(t for t in chosen.terms if t != own)
    simpler = [
        t for t in search.candidates(rest)
        if search.terms[t].effect in term.generalises and search.terms[t].acts_on == term.acts_on
    ]  # fmt: skip
    if not simpler or search.budget.over("two effects in place of one"):
        return []
    # the model may have been calibrated for another use: pairs are compared with what it is worth row by row
    whole = _best(search, [Hypothesis(chosen.optimum.z, search.free(chosen.terms), search.ones)])
    found = []
    for special in simpler:
        less = (*rest, special)
        fit = _best(search, search.hypotheses(less, special, search.off(whole.z, (own,))))
        if fit.log_evidence >= whole.log_evidence - TIE:
            continue  # alone it is a rival, and named as one
        before = Trial(less, fit)
        candidates = [t for t in search.candidates(less) if t != own and not search.terms[t].depends_on]
        starts = search.starts(before, candidates)
        promised = dict[int, float]()
        for (t, _), score in zip(starts, search.promises(before, starts), strict=True):
            promised[t] = max(promised.get(t, 0.0), score.gain)
        hopeful = [t for t in promised if promised[t] > MOST_OF_IT * (fit.loss - whole.loss)]
        for t in sorted(hopeful, key=lambda t: -promised[t])[:FITTED]:
            pair = _best(search, search.hypotheses((*less, t), t, fit.z))
            if pair.loss <= whole.loss + SAME or pair.log_evidence >= whole.log_evidence - TIE:
                found.append((search.terms[special], search.terms[t]))
    return found


def _best(search: Search, hypotheses: list[Hypothesis]) -> Optimum:
    return max(search.fitter(hypotheses), key=lambda o: o.log_evidence)
