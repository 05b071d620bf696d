"""Two effects in place of one that holds one of them.

Dry friction that differs between the directions is Coulomb friction beside a constant load, but for the lowest speeds. Neither
name is wrong where the data show little of those, and one effect is the shorter answer: the pairs are said beside it. So are
those of an effect that nearly won: a dead zone beside an offset of one sensor may look like a scale of another one.
"""

import numpy as np

from simpel_cli.discovery.search.trials import SAME, TIE, Search, Trial, asked
from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simulators.effects import Term

# of what an effect explains beyond its special case: so much another one has to promise to first order, which is about the
# best size of the special case alone, and may be far from that of both
A_GOOD_PART = 0.2
NEAR = asked(2)  # nats behind the chosen effect: so much a second effect has to earn, which may be what it lacks
NEARLY_WON = 2  # effects that are asked, of those alike one
FITTED = 8  # pairs: what promises to saturate a signal promises too much, and is fitted in vain


def two_in_place(search: Search, chosen: Trial, place: int) -> list[tuple[Term, Term]]:
    """Return the pairs that do as well as one chosen effect, or little better.

    One of the two is a special case where it acts, or an effect that nearly won in its place. Neither alone does, and the other
    one is no more general form of the first: that would be a rival by itself.

    Args:
        search: over sets of effects.
        chosen: the model.
        place: of the effect in it.
    """
    own = chosen.terms[place]
    term, rest = search.terms[own], tuple(t for t in chosen.terms if t != own)
    simpler = [t for t in search.candidates(rest) if t != own and _is_special(search.terms[t], term)]
    halves = [*simpler, *(t for t in _nearly_won(search, chosen, own) if t not in simpler)]
    if not halves or search.budget.over("two effects in place of one"):
        return []
    search.report(f"is {term.label} two effects")
    # the model may have been calibrated for another use: pairs are compared with what it is worth row by row
    z = chosen.optimum.z
    whole = _best(
        search, chosen.terms, [Hypothesis(at, search.free(chosen.terms), search.ones) for at in (z, search.loud(z))]
    )
    off = search.off(whole.z, (own,))
    found: list[tuple[int, int]] = []
    for special in halves:
        less = (*rest, special)
        before = Trial(less, _best(search, less, search.hypotheses(less, special, off)))
        if _as_good(before.optimum, whole) or _better(before.optimum, whole):
            continue  # alone it is a rival, and named as one
        others = [
            t for t in search.candidates(less)
            if t != own and not search.terms[t].depends_on and not _is_special(search.terms[special], search.terms[t])
        ]  # fmt: skip
        for t in _promising(search, before, others, A_GOOD_PART * (before.optimum.loss - whole.loss)):
            pair, alone = (*less, t), (*rest, t)
            both = _best(search, pair, search.hypotheses(pair, t, before.optimum.z))
            ahead = both.log_evidence - whole.log_evidence
            if not (_as_good(both, whole) or 0 < ahead <= asked(2)):  # what one effect more has to earn, it did not
                continue
            by_itself = _best(search, alone, search.hypotheses(alone, t, off))
            known = any({special, t} == {*earlier} for earlier in found)
            if not (known or _as_good(by_itself, whole) or _better(by_itself, whole)):
                found.append((special, t))
    return [(search.terms[special], search.terms[t]) for special, t in found]


def _nearly_won(search: Search, chosen: Trial, own: int) -> list[int]:
    """Return the effects that did nearly as well as a chosen one in its place, best first; of those that are alike one."""
    rest = tuple(t for t in chosen.terms if t != own)
    best = search.known.get(frozenset(chosen.terms), chosen.optimum).log_evidence
    known = [(t, search.known.get(frozenset((*rest, t)))) for t in search.candidates(rest) if t != own]
    near = sorted(
        ((t, fit) for t, fit in known
         if fit is not None and not search.terms[t].depends_on and TIE < best - fit.log_evidence < NEAR),
        key=lambda found: -found[1].log_evidence,
    )  # fmt: skip
    apart: list[tuple[int, Optimum]] = []
    for t, fit in near:
        if not any(abs(fit.loss - other.loss) <= SAME for _, other in apart):
            apart.append((t, fit))
    return [t for t, _ in apart[:NEARLY_WON]]


def _is_special(simple: Term, general: Term) -> bool:
    """Whether an effect is a special case of another, where that acts or takes from."""
    place, *_ = general.acts_on.split(", ")
    return simple.effect in general.generalises and place in (simple.acts_on, *simple.acts_on.split(", "))


def _promising(search: Search, before: Trial, candidates: list[int], least: float) -> list[int]:
    """Return the terms that promise most beside a model, at least so many nats; what cannot be told is left out."""
    starts = search.starts(before, candidates)
    search.tried += len(candidates)
    promised = dict[int, float]()
    for (t, _), score in zip(starts, search.promises(before, starts), strict=True):
        if np.isfinite(score.gain):
            promised[t] = max(promised.get(t, 0.0), score.gain)
    return sorted((t for t in promised if promised[t] > least), key=lambda t: -promised[t])[:FITTED]


def _best(search: Search, terms: tuple[int, ...], hypotheses: list[Hypothesis]) -> Optimum:
    """Return the best of some fits, each of which is fitted once more from where it ended, and of those known."""
    first = search.fitter(hypotheses)
    again = search.fitter([Hypothesis(search.loud(o.z), o.free, search.ones) for o in first])
    known = [search.known[frozenset(terms)]] if frozenset(terms) in search.known else []
    return max([*first, *again, *known], key=lambda o: o.log_evidence)


def _as_good(fit: Optimum, whole: Optimum) -> bool:
    """Whether a model does as well as another one, and no better; widths of priors alone tell no two apart."""
    alike = len(fit.free) <= len(whole.free) and abs(fit.loss - whole.loss) <= SAME
    return alike or abs(fit.log_evidence - whole.log_evidence) <= TIE


def _better(fit: Optimum, whole: Optimum) -> bool:
    """Whether a model is ahead, by however much: a half that does better by itself needs no other."""
    return fit.log_evidence > whole.log_evidence
