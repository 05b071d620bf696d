"""A last look at what a chosen model leaves, whether it is a function of two arguments.

Functions of two arguments are many and wide, so the program of a search does not carry them. Where nothing else was left
they are screened without a program (`promising`); the best are compiled into a small one with the chosen effects, fitted
from the chosen optimum, and judged like everything else: by evidence and on held-out episodes.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.gate.held_out import Gate, gates
from simpel_cli.discovery.search.smaller import fitted_again, small_search
from simpel_cli.discovery.search.trials import ACCEPT
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.search.unexplained.pair_screening import Promise, promised
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import Key, Setup, key_of
from simulators.effects import Term, functions_of_two
from simulators.groups import slots_of

BASES = (2, 4)  # waves per argument: a function that needs few is seen sooner with few
MOST_FITTED = 2
SHARE = 0.5  # of the largest promise, for a second one to be fitted
MOST_ARGUMENTS = 10


class Interaction(NamedTuple):
    """A function of two arguments that earned its place.

    Args:
        term: what it is.
        kept: places of the chosen effects that still earn theirs beside it.
        gain: in evidence, over the model with those effects, nats.
        gate: over the same.
    """

    term: Term
    kept: tuple[int, ...]
    gain: float
    gate: Gate


def interaction(
    levels: NoiseProfile,
    attach: Callable[..., Setup],
    side_by_side: int,
    report: Callable[[str], None] = lambda _: None,
    known: float = 0.0,
) -> Interaction | None:
    """Return the function of two arguments that the data ask for beside the chosen terms; None where there is none.

    Args:
        levels: of the model that a search ended with.
        attach: (kept, extra) -> the setup of a program with these terms alone.
        side_by_side: fits that run side by side.
        report: takes a line that says what goes on.
        known: evidence that a function of one argument earns there, which one of two has to beat, nats.
    """
    search, assessor, chosen = levels.search, levels.assessor, levels.chosen
    model = search.plan.augmented.model
    slots = sum(len(column) for column in slots_of(model))  # which group a row is of is no argument
    brought = {store.name for t in search.terms for store in t.stores}  # a state that is a guess itself is no argument
    if len(model.states) - len(brought) + len(model.inputs) - slots > MOST_ARGUMENTS:
        return None
    here: set[Key] = {key_of(t) for t in search.terms}
    every = [t for n in BASES for t in functions_of_two(model, search.plan.scales, n) if key_of(t) not in here]
    terms = [t for t in every if not brought & {t.acts_on, *t.depends_on}]
    going = _worth_a_fit(promised(levels, terms), terms, known + ACCEPT)
    if not going:
        return None
    report("is it a function of " + ", or of ".join(" and ".join(t.depends_on) for t in going))
    kept = {key_of(search.terms[t]) for t in chosen.terms}
    plan = attach(kept=frozenset(kept), extra=going)._replace(windows=search.plan.windows, spare=search.plan.spare)
    unknowns = sum(len(search.all_rows(t)) for t in chosen.terms) + max(len(t.parameters) for t in going)
    small = small_search(plan, side_by_side, unknowns)
    before = fitted_again(small, search, chosen)
    own, names = before.terms, [key_of(t) for t in small.terms]
    trials = small.add(before, [names.index(key_of(t)) for t in going]).trials
    search.tried += len(going)
    if not trials:
        return None
    whole, new = trials[0], trials[0].terms[-1]
    # so that the smaller model has had every chance that the larger one had
    before = small.best(
        own, small.fitter([Hypothesis(small.off(whole.optimum.z, (new,)), small.free(own), small.ones)])
    )
    if not whole.optimum.log_evidence - before.optimum.log_evidence > known + ACCEPT:
        return None
    after = small.prune(whole)[0]  # an effect that was named for want of this function is needed no longer
    if new not in after.terms:
        return None
    rest = tuple(t for t in own if t in after.terms)
    before = small.best(rest, small.fitter(small.less(after, rest)))
    gain = after.optimum.log_evidence - before.optimum.log_evidence
    (judged,) = gates(small, assessor.of(plan), after, [before])
    return Interaction(small.terms[new], tuple(i for i, t in enumerate(own) if t in rest), float(gain), judged)


def _worth_a_fit(promises: Sequence[Promise], terms: Sequence[Term], least: float) -> list[Term]:
    """Return the functions that promise most, each with as many waves and of the size that promise most of it."""
    best: dict[Key, tuple[float, Term]] = {}
    for promise, term in zip(promises, terms, strict=True):
        gain = promise.gain - float(np.log(len(BASES)))
        if gain > best.get(key_of(term), (-np.inf, term))[0]:
            best[key_of(term)] = gain, sized(term, promise.size)
    order = sorted(best.values(), key=lambda found: -found[0])
    return [term for gain, term in order[:MOST_FITTED] if gain > max(least, SHARE * order[0][0])]


def sized(term: Term, size: float) -> Term:
    """Return a function with that share of the standard deviations of its weights."""
    return term._replace(parameters=tuple(k._replace(low=size * k.low, high=size * k.high) for k in term.parameters))
