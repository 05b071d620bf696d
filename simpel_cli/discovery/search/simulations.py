"""A search by what a model is worth as a simulator: every episode is one simulation, and what it leaves has a memory.

One row ahead a wrong model may do as well as the right one, if noise of the process makes up for it; where the states are not
all measured, it may do better. So a model that will be used for simulations is searched for by those, with the same effects,
evidence and gates. What was found is then said in the coordinates of the ordinary search, in which the noise alone is fitted
once more: residuals, errors ahead and what is left are looked at there. What simulations leave has a memory, which follows a
wrong sensor as well as a right one; so an effect that makes predictions of the ordinary filter worse there is not accepted.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.acceptance import accepted, judgement, proposed
from simpel_cli.discovery.search.again import Earlier, path_in
from simpel_cli.discovery.search.gate.growth import growth
from simpel_cli.discovery.search.gate.held_out import AHEAD, Gate
from simpel_cli.discovery.search.ranges import Wider
from simpel_cli.discovery.search.sets.selection import Selection, worth
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.share import shares
from simpel_cli.discovery.search.smaller import carried, carried_windows, names_of
from simpel_cli.discovery.search.trials import ACCEPT, Search, Stage, Trial
from simpel_cli.discovery.search.uses import FREE_RUN
from simpel_cli.filtering.errors_ahead import Assessment, Assessor, rmse, with_lost
from simpel_cli.filtering.likelihood.fit import Fitter, Hypothesis, Optimum
from simpel_cli.filtering.setup import Setup
from simpel_cli.runs.console import Terminal

NEARLY_ALL = 0.8  # of the mean square error of a free run beyond the noise: beside that simulations ask for little


def worth_simulating(found: Search, assessor: Assessor, selection: Selection, options: Discovery) -> bool:
    """Whether there is a search by simulations: as the user says, or where one is worth making.

    That is where a model is for free runs, and what an ordinary search has found leaves much of the error of one, of any
    quantity; not beside groups, where it would take for effects what differs from one to another. Where one of the two models
    runs away, its error is large; where both do, nothing is known.
    """
    plan = found.plan
    if options.simulations is not None:
        return options.simulations
    if options.for_ != FREE_RUN or plan.augmented.model.groups:
        return False
    n_p, n_r, _ = plan.coordinates.sizes
    z = selection.chosen.optimum.z
    noise = np.array([plan.coordinates.value(i, float(z[i])) for i in range(n_p, n_p + n_r)])
    before, after = with_lost(
        *(assessor(trial.optimum.z, plan.windows).free for trial in (selection.base, selection.chosen))
    )
    return bool(np.any(shares(rmse(before), rmse(after), noise) < NEARLY_ALL))


def simulating(found: Search, base: Trial, attach: Callable[..., Setup], fitter: Callable[[Setup], Fitter]) -> Search:
    """Return the search by simulations in the windows of an ordinary one.

    Args:
        found: the ordinary search.
        base: its calibrated simulator.
        attach: returns the setup with the same effects in which episodes are simulations.
        fitter: of a setup.
    """
    plan, old = attach(), found.plan
    plan = plan._replace(windows=carried_windows(old, plan), spare=None)
    plan = plan._replace(optimum=_begun(old, base.optimum.z, plan))
    search = Search(plan, fitter(plan), found.report)
    search.budget, search.banned = found.budget, set(found.banned)
    return search


def _begun(old: Setup, z: np.ndarray, plan: Setup) -> np.ndarray:
    """Return a start at the parameters of the ordinary calibration: of the noise nothing is known yet."""
    start = carried(old, z, plan)
    n_p = plan.coordinates.sizes[0]
    start[n_p:] = plan.start[n_p:]
    return start


def chosen_by_simulations(
    found: Search, selection: Selection, simulated: Search, assessors: tuple[Assessor, Assessor], options: Discovery,
    terminal: Terminal, wider: Callable[[Search, Trial], Wider | None] = lambda *_: None, earlier: Earlier | None = None,
) -> tuple[Selection, list[Gate]] | Wider | None:  # fmt: skip
    """Return other effects that simulations ask for, with their gates; None: they ask for none that are worth more.

    Where they ask for wider ranges first, these are returned.

    Args:
        found: the ordinary search.
        selection: what it has chosen: the search by simulations begins with that, too.
        simulated: the search by simulations.
        assessors: of the ordinary program, and of its own.
        options: of the search.
        terminal: takes lines.
        wider: whether ranges are too narrow for a model.
        earlier: what a search by simulations has chosen in narrower ranges: this one may begin with that instead.
    """
    terminal.line("by simulations, whose remainders have a memory", "search")
    in_filter, assessor = assessors
    path = [simulated.base()]
    for trial in selection.path[1:]:
        start = Hypothesis(
            _begun(found.plan, trial.optimum.z, simulated.plan), simulated.free(trial.terms), simulated.ones
        )
        path.append(simulated.best(trial.terms, simulated.fitter([start])))
    own, begun = path[-1], [tuple(path)]
    if earlier is not None and (known := path_in(simulated, path[0], earlier)):
        begun.append(known)

    def ask(at: Selection, _: bool) -> Wider | None:
        ends = wider(simulated, at.chosen)
        if ends is None or spoiling(simulated, found, in_filter, at.chosen) is not None:
            return None
        return ends._replace(simulated=Earlier(simulated, at.chosen))

    while True:
        banned = frozenset(simulated.banned)
        allowed = (_cut(paths, banned) for paths in begun)
        other = proposed(simulated, assessor, path[0], options, max(allowed, key=lambda p: worth(p[-1])))
        spoils = spoiling(simulated, found, in_filter, other.chosen)
        if spoils is None:
            outcome = judgement(simulated, assessor, other, terminal, ask=ask)
            if isinstance(outcome, Wider):
                return outcome
            judged, gates = outcome
            other, gates = accepted(simulated, assessor, judged, gates, terminal)
            spoils = spoiling(simulated, found, in_filter, other.chosen)
            if spoils is None and other.chosen.terms != judged.chosen.terms and (ends := ask(other, True)) is not None:
                return ends
        if spoils is None:
            break
        # from the beginning: what was found beside it, or refused, may have been so for its sake
        simulated.banned = {*banned, spoils.term}
        label = simulated.terms[spoils.term].label
        terminal.line(f"{label}: the error of {spoils.error} grows {spoils.times:.3g} times: not accepted", "gate")
        if simulated.budget.over("simulations without what makes the filter worse"):
            return None
    better = worth(other.chosen) > worth(own) + ACCEPT and set(other.chosen.terms) != set(own.terms)
    if not other.chosen.terms or not better:
        terminal.line("they ask for nothing else", "search")
        return None
    return other, gates


def _cut(path: tuple[Trial, ...], banned: frozenset[int]) -> tuple[Trial, ...]:
    """Return a path as far as it has no banned effect; the simulator alone is always there."""
    return tuple(trial for trial in path if not banned.intersection(trial.terms))


class Spoiling(NamedTuple):
    """An effect that makes predictions of the ordinary filter worse.

    Args:
        term: which of the search's.
        error: that grows most, in words.
        times: how often it is as large as without the effect.
    """

    term: int
    error: str
    times: float


def spoiling(simulated: Search, search: Search, assessor: Assessor, chosen: Trial) -> Spoiling | None:
    """Return the effect with which an error of the ordinary filter, in the rows of its search, surely grows most.

    With and without it parameters are those that simulations give, and noise is fitted to these rows.

    Args:
        simulated: the search by simulations.
        search: the ordinary one.
        assessor: of its program.
        chosen: a model of the search by simulations.
    """
    windows, names = search.plan.windows, search.plan.augmented.measured

    def assessed(trial: Trial) -> Assessment:
        (noisy,) = _noisy(search, [_moved(simulated, trial, search)])
        return assessor(noisy.z, windows)

    def asked(trial: Trial) -> Assessment:
        return simulated.once(("in the filter", trial.terms, trial.optimum.z.tobytes()), partial(assessed, trial))

    found: list[Spoiling] = []
    for gone in chosen.terms:
        part = simulated.part(chosen, tuple(t for t in chosen.terms if t != gone))
        without, with_it = asked(part), asked(chosen)
        # free runs are what simulations judge
        before, after = ({AHEAD[name]: getattr(e, name) for name in ("one_step", "ahead")} for e in (without, with_it))
        grown = growth(before, after, names, windows.episode)
        found += [Spoiling(gone, f"{g.channel} {g.ahead}", g.times) for g in grown]
    return max(found, key=lambda spoils: spoils.times, default=None)


def in_rows(simulated: Search, selection: Selection, search: Search) -> Selection:
    """Return what a search by simulations found in the coordinates of the ordinary search.

    Parameters are as the simulations say, and as certain; levels of noise are fitted anew; evidence of a set is that of the
    ordinary search there, gains are those of the simulations.
    """
    rivals = (t for rivals in selection.classes for t in rivals)
    sets = {frozenset(t.terms): t for t in (*rivals, selection.base, selection.chosen, *selection.path)}
    moved = [_moved(simulated, t, search) for t in sets.values()]
    here = search.fitter(
        [Hypothesis(o.z, search.free(t.terms), search.ones) for t, o in zip(moved, _noisy(search, moved), strict=True)],
        1,
    )
    search.forget()
    search.banned = simulated.banned
    search.tried += simulated.tried
    for trial, optimum in zip(moved, here, strict=True):
        search.known[frozenset(trial.terms)] = _as_certain(search, optimum, trial.optimum)
    own = lambda t: Trial(t.terms, search.known[frozenset(t.terms)])  # noqa: E731
    return selection._replace(
        base=own(selection.base),
        chosen=own(selection.chosen),
        path=tuple(own(t) for t in selection.path),
        classes=tuple(tuple(own(t) for t in rivals) for rivals in selection.classes),
        stages=tuple(
            Stage(
                _moved(simulated, s.before, search), tuple(_moved(simulated, t, search) for t in s.trials), s.screened
            )
            for s in selection.stages
        ),
    )


def _noisy(search: Search, moved: Sequence[Trial]) -> list[Optimum]:
    """Return models with the parameters of simulations and levels of noise that suit the rows of the ordinary search."""
    return search.fitter([Hypothesis(t.optimum.z, search.noise, search.ones) for t in moved])


def _moved(simulated: Search, trial: Trial, search: Search) -> Trial:
    """Return a fit in other coordinates, by the names of its unknowns; its evidence is as it was."""
    names, known = names_of(search.plan), names_of(simulated.plan)
    optimum, free = trial.optimum, search.free(trial.terms)
    row = {known[i]: k for k, i in enumerate(optimum.free)}
    there = [row.get(names[i]) for i in free]
    z = carried(simulated.plan, optimum.z, search.plan)
    n_p, n_r, _ = search.plan.coordinates.sizes
    z[n_p + n_r : -1] = search.plan.start[n_p + n_r : len(z) - 1]

    def picked(values: np.ndarray, default: np.ndarray) -> np.ndarray:
        return np.array([d if k is None else values[k] for k, d in zip(there, default, strict=True)])

    inside = [k for k, at in enumerate(there) if at is not None]
    at = [k for k in there if k is not None]

    def picked_both(values: np.ndarray, default: float) -> np.ndarray:
        found = default * np.eye(len(free))
        found[np.ix_(inside, inside)] = values[np.ix_(at, at)]
        return found

    moved = optimum._replace(
        z=z,
        free=free,
        gradient=picked(optimum.gradient, np.zeros(len(free))),
        centre=picked(optimum.centre, z[list(free)]),
        fisher=picked_both(optimum.fisher, 1.0),
        covariance=picked_both(optimum.covariance, 1.0),
    )
    return Trial(trial.terms, moved)


def _as_certain(search: Search, here: Optimum, said: Optimum) -> Optimum:
    """Return an optimum whose parameters are as certain as the simulations say; of the noise the rows say it."""
    own = np.array([i not in search.noise for i in here.free])
    covariance = np.where(own[:, None] & own[None], said.covariance, 0.0)
    covariance += np.where(own[:, None] | own[None], 0.0, here.covariance)
    finite = bool(np.isfinite(here.loss))
    return here._replace(centre=np.where(own, said.centre, here.centre), covariance=covariance, converged=finite)
