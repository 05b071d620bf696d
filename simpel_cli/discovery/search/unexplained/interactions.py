"""A last look at what a chosen model leaves, whether it is a function of two arguments, or a parameter that depends on one.

These functions are many and wide, so the program of a search does not carry them. Where nothing else was left they are
screened without a program (`promised`); the best are compiled into a small one with the chosen effects, fitted from the
chosen optimum, and judged like everything else: by evidence and on held-out episodes. A parameter that depends on something
may also be what the chosen effects stand for, so it is screened without these, too.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.gate.held_out import Gate, gates
from simpel_cli.discovery.search.sets.selection import worth
from simpel_cli.discovery.search.smaller import fitted_again, small_search
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.discovery.search.unexplained.dependent_parameters import dependent_parameters
from simpel_cli.discovery.search.unexplained.drifts import HALF
from simpel_cli.discovery.search.unexplained.function_screening import Promise, promised
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.filtering.setup import Key, Setup, key_of
from simulators.effects import Term, functions_of_two
from simulators.effects.term import PARAMETER
from simulators.effects.unnamed import arguments_of

BASES = (2, 4)  # waves per argument: a function that needs few is seen sooner with few
MOST_FITTED = 2
SHARE = 0.5  # of the largest promise, for a second one to be fitted
MOST_ARGUMENTS = 10


class Interaction(NamedTuple):
    """A function that earned its place.

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
    alone: NoiseProfile,
    attach: Callable[..., Setup],
    side_by_side: int,
    report: Callable[[str], None] = lambda _: None,
    known: float = 0.0,
) -> Interaction | None:
    """Return the function that the data ask for beside the chosen terms, or in their place; None where there is none.

    Args:
        levels: of the model that a search ended with.
        alone: of the simulator.
        attach: (kept, extra) -> the setup of a program with these terms alone.
        side_by_side: fits that run side by side.
        report: takes a line that says what goes on.
        known: evidence that a function of one argument earns there, which another one has to beat, nats.
    """
    search, assessor, chosen = levels.search, levels.assessor, levels.chosen
    model = search.plan.augmented.model
    brought = {store.name for t in search.terms for store in t.stores}
    if len(arguments_of(model)) - len(brought) > MOST_ARGUMENTS:
        return None
    going, least = _screened(levels, alone, known)
    if not going:
        return None
    report("is it that " + ", or that ".join(map(in_words, going)))
    kept = {key_of(search.terms[t]) for t in chosen.terms}
    plan = attach(kept=frozenset(kept), extra=going)._replace(windows=search.plan.windows, spare=search.plan.spare)
    unknowns = sum(len(search.all_rows(t)) for t in chosen.terms) + max(len(t.parameters) for t in going)
    small = small_search(plan, side_by_side, unknowns)
    before = fitted_again(small, search, chosen)
    own, names = before.terms, [key_of(t) for t in small.terms]
    trials = small.add(before, [names.index(key_of(t)) for t in going]).trials
    search.tried += len(going)
    settled = [(after, trial.terms[-1]) for trial in trials for after in _settled(small, trial)]
    before = small.best(own, ())  # which has had every chance that the larger ones had
    for after, new in sorted(settled, key=lambda found: -worth(found[0])):
        rest = tuple(t for t in own if t in after.terms)
        earned = after.optimum.log_evidence - before.optimum.log_evidence
        if not earned > (least if rest == own else known + ACCEPT):  # an effect was one of many, too
            continue
        less = before if rest == own else small.best(rest, small.fitter(small.less(after, rest)))
        judged, *instead_of = gates(small, assessor.of(plan), after, [less] + ([before] if rest != own else []))
        if any(gate.harm or gate.high < 0 for gate in instead_of):  # than the effects that would go it does worse
            continue
        gain = after.optimum.log_evidence - less.optimum.log_evidence
        return Interaction(small.terms[new], tuple(i for i, t in enumerate(own) if t in rest), float(gain), judged)
    return None


def _screened(levels: NoiseProfile, alone: NoiseProfile, known: float) -> tuple[list[Term], float]:
    """Return the functions that are worth a fit, beside the effects or in their place, and what one has to earn, nats."""
    search, chosen = levels.search, levels.chosen
    model = search.plan.augmented.model
    here: set[Key] = {key_of(t) for t in search.terms}
    every = [t for n in BASES for t in functions_of_two(model, search.plan.scales, n) if key_of(t) not in here]
    every += dependent_parameters(search, chosen, BASES)
    brought = {store.name for t in search.terms for store in t.stores}  # a state that is a guess itself is no argument
    terms = [t for t in every if not brought & {t.acts_on, *t.depends_on}]
    least = known + ACCEPT + float(np.log(max(len({key_of(t) for t in terms}), 1)))  # each is as probable as the others
    going = _worth_a_fit(promised(levels, terms), terms, least)
    if chosen.terms:
        instead = [t for t in terms if t.kind == PARAMETER and t.acts_on in [q.name for q in model.params]]
        effects = chosen.optimum.log_evidence - alone.chosen.optimum.log_evidence
        more = _worth_a_fit(promised(alone, instead), instead, max(HALF * effects, least))
        going += [t for t in more if key_of(t) not in [*map(key_of, going)]]
    return going, least


def in_words(term: Term) -> str:
    """Return what a function says."""
    return term.meaning if term.kind == PARAMETER else f"a function of {' and '.join(term.depends_on)} acts"


def _settled(small: Search, whole: Trial) -> list[Trial]:
    """Return a model with a function as it is, and with those of its effects alone that earn their place beside it.

    An effect that was named for want of the function goes, but not one of whose size the function is a part.
    """
    new, after = whole.terms[-1], small.prune(whole)[0]
    owners = {t for t in whole.terms[:-1] if small.terms[new].acts_on in [k.name for k in small.terms[t].parameters]}
    return [whole] if after.terms == whole.terms or not owners | {new} <= {*after.terms} else [after, whole]


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
