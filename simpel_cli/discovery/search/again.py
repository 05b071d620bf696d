"""A search that is made once more, in other ranges or with other noise, begins with what the last one chose, too."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.smaller import carried, carried_windows, fitted_again, small_search
from simpel_cli.discovery.search.trials import Search, Stage, Trial, asked
from simpel_cli.discovery.search.unexplained.memories import Memory
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import Setup, key_of, members
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression, Term


class Earlier(NamedTuple):
    """What an earlier search has chosen.

    Args:
        search: it.
        chosen: its model.
        heavy: whether the noise had heavy tails there.
        settled: whether it was chosen in the same ranges and noise, or in coarser steps, so that only what stands beside it, or
            beside what is left of it, is asked.
        stages: what was tried on the way there.
    """

    search: Search
    chosen: Trial
    heavy: bool = False
    settled: bool = False
    stages: tuple[Stage, ...] = ()


def stages_in(search: Search, earlier: Earlier, path: Sequence[Trial]) -> tuple[Stage, ...]:
    """Return the stages of an earlier search until where this one begins, with their terms as they are called here."""
    place = {key_of(term): t for t, term in enumerate(search.terms)}
    here = {t: place.get(key_of(term)) for t, term in enumerate(earlier.search.terms)}

    def called(trial: Trial) -> Trial | None:
        terms = [here[t] for t in trial.terms]
        return None if None in terms else Trial(tuple(t for t in terms if t is not None), trial.optimum)

    found = []
    for stage in earlier.stages:
        before, trials = called(stage.before), [t for t in map(called, stage.trials) if t is not None]
        if before is not None and len(before.terms) < len(path[-1].terms):
            found.append(Stage(before, tuple(trials)))
    return tuple(found)


def path_in(search: Search, base: Trial, earlier: Earlier) -> tuple[Trial, ...]:
    """Return fits from the calibrated simulator to the effects that an earlier search has chosen, as far as they are here.

    Args:
        search: in which they are fitted.
        base: its calibrated simulator.
        earlier: what was chosen there.
    """
    place = {key_of(term): t for t, term in enumerate(search.terms)}
    keys = [key_of(earlier.search.terms[t]) for t in earlier.chosen.terms]
    terms = tuple(place[key] for key in keys if key in place and place[key] not in search.banned)
    while not search.fits(terms):  # another program may have had more room
        terms = terms[:-1]
    if not terms:
        return ()
    if earlier.settled:
        search.together |= earlier.search.together
    z = search.loud(carried(earlier.search.plan, earlier.chosen.optimum.z, search.plan))
    sets = [terms[: k + 1] for k in range(len(terms))]
    starts = [Hypothesis(search.off(z, terms[k + 1 :]), search.free(here), search.ones) for k, here in enumerate(sets)]
    fits = search.fitter(starts)
    return (base, *(search.best(here, [fit]) for here, fit in zip(sets, fits, strict=True)))


def beside(earlier: Earlier, attach: Callable[..., Setup], new: Sequence[Term], side_by_side: int) -> Earlier | None:
    """Return what was chosen and the one of some new terms that earns most beside it; None: none earns what it has to.

    A search with terms that its program has no room for begins from the start: they are asked in a small program first.

    Args:
        earlier: what was chosen.
        attach: (kept, extra) -> the setup of a program with these terms alone.
        new: terms that the search did not have.
        side_by_side: fits that run side by side.
    """
    search, chosen = earlier.search, earlier.chosen
    plan = attach(kept=frozenset(key_of(search.terms[t]) for t in chosen.terms), extra=new)
    plan = plan._replace(windows=carried_windows(search.plan, plan), spare=None)
    own, one_more = sum(len(search.all_rows(t)) for t in chosen.terms), max(len(t.parameters) for t in new)
    small = small_search(plan, side_by_side, own + one_more + members(plan))
    before = fitted_again(small, search, chosen)
    keys = {key_of(t) for t in new}
    stage = small.add(before, [t for t, term in enumerate(small.terms) if key_of(term) in keys])
    if not stage.trials:
        return None
    best = stage.trials[0]
    before = small.best(before.terms, small.fitter(small.less(best, before.terms)))  # it may have led there
    gain = best.optimum.log_evidence - before.optimum.log_evidence
    if gain <= asked(len(chosen.terms) + 1):
        return None
    small.together = set(search.together)
    return earlier._replace(search=small, chosen=best, settled=True, stages=())


class Again(NamedTuple):
    """Effects with a state of their own, with which a search is worth making again.

    Args:
        memory: they.
        earlier: what was chosen, beside which they promise; None: they do in its place.
        effects: with those that differ from group to group; None: as they were given.
        simulated: what a search by simulations has chosen without them.
    """

    memory: Memory
    earlier: Earlier | None
    effects: list[Expression] | None = None
    simulated: Earlier | None = None


def asked_again(
    earlier: Earlier, memory: Memory, chosen_too: bool, attach: Callable[..., Setup], options: Discovery, terminal: Terminal
) -> Again | None:  # fmt: skip
    """Return the search with effects that have a state of their own, where one of them earns what an effect has to."""
    if not chosen_too:
        return Again(memory, None)
    found = beside(earlier, attach, memory.terms, options.lanes)
    promise = f"{memory.label} promises +{memory.gain:.0f}"
    if found is None:
        terminal.line(f"{promise}, and earns less than it has to", "memory")
        return None
    unknowns = len(found.search.free(found.chosen.terms)) - len(found.search.free(()))
    if unknowns > options.room + members(found.search.plan):
        terminal.line(f"{promise}: no room beside what was chosen (discovery.room={unknowns})", "memory")
        return None
    return Again(memory, found if earlier.chosen.terms else None)  # alone it is one beginning of many
