"""A whole search: in clean measurements, with the inputs between rows and the differences between groups that it finds."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from simpel_cli.data import Recording
from simpel_cli.discovery.ground import Ground, ground_of
from simpel_cli.discovery.last_calibration import last_calibration
from simpel_cli.discovery.search.acceptance import accepted, harmless, judgement, proposed, with_interactions
from simpel_cli.discovery.search.again import Again, Earlier, asked_again, path_in
from simpel_cli.discovery.search.between_rows import Preference, asked_beside, in_words, saying, words_of
from simpel_cli.discovery.search.by_group.grouping import Grouping, confirmed, grouped_effects, groupings
from simpel_cli.discovery.search.by_group.grouping import in_words as grouping_in_words
from simpel_cli.discovery.search.by_group.own_parameters import own_parameters, per_of, with_own
from simpel_cli.discovery.search.calibration import Calibrated, calibrated, prepared, with_heavy_tails
from simpel_cli.discovery.search.gate.held_out import Gate
from simpel_cli.discovery.search.integration import Finer, too_coarse
from simpel_cli.discovery.search.ranges import MOST_WIDER, Wider, too_narrow, widened
from simpel_cli.discovery.search.ranges import in_words as ranges_in_words
from simpel_cli.discovery.search.sets.selection import Selection, beaten, cut
from simpel_cli.discovery.search.simulations import chosen_by_simulations, in_rows, simulating, worth_simulating
from simpel_cli.discovery.search.smaller import fitter_of
from simpel_cli.discovery.search.trials import TIE, Search, Trial
from simpel_cli.discovery.search.unexplained.disturbances import Disturbance, time_dependent_disturbance
from simpel_cli.discovery.search.unexplained.drifts import BETWEEN, Drift, drifting, stands_for
from simpel_cli.discovery.search.unexplained.instead_of_drifts import needed_beside, suspected
from simpel_cli.discovery.search.unexplained.memories import Memory, worth_a_search
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.search.uses import FREE_RUN, ONE_STEP, windows_for
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.measurements.cleaning import outlier_check
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import MOST_GROUPED, Setup, key_of, members, terms_of, with_memory
from simpel_cli.runs.console import Terminal
from simpel_cli.studies.open import Study
from simulators.effects import Expression

First = Wider | Finer  # what has to be known before anything is judged


class Searched(NamedTuple):
    """What a search came to, before it is put into words.

    Args:
        search: its fits.
        assessor: of errors ahead.
        selection: the models before and after.
        gates: what every chosen effect adds on held-out episodes.
        disturbance: a force that goes with time alone; None: there is none.
        windows: held-out ones.
        recording: the measurements that were searched in, with what was found in them.
        between_rows: input -> what it does between rows, where neither simulator nor data say.
        degrees_of_freedom: measured channel -> nu of Student's t, of those whose noise has heavy tails.
        groupings: what it is worth that a parameter of the simulator, or an effect, differs from group to group.
        drift: a parameter that is no constant; None: there is none.
        wider: nats by which the evidence of the chosen model is ahead of that within the ranges that were declared.
        again: a search that is worth making once what differs from group to group is known; None: there is none.
        for_use: calibrates a model of the search for what it will be used for.
        by_simulations: whether a search by simulations has chosen.
    """

    search: Search
    assessor: Assessor
    selection: Selection
    gates: list[Gate]
    disturbance: Disturbance | None
    windows: Windows
    recording: Recording
    between_rows: dict[str, Preference]
    degrees_of_freedom: dict[str, float]
    groupings: list[Grouping]
    wider: float = 0.0
    drift: Drift | None = None
    again: Again | None = None
    for_use: Callable[[Trial], Trial] = lambda trial: trial
    by_simulations: bool = False


def search_of(study: Study, terminal: Terminal) -> Searched:
    """Clean the measurements and search; once more with wider ranges or a hidden state; calibrate for the use that is named."""
    effects: list[Expression] = study.declared.groups["effect"]
    ground = ground_of(study, len(effects), terminal)
    with terminal.working(ground.watch.__str__):
        return _searched(ground, effects)


def _searched(ground: Ground, effects: list[Expression]) -> Searched:
    declared, terminal = ground.model, ground.terminal
    found = _search_in_groups(ground, effects)
    while not isinstance(found, Searched):
        if isinstance(found, First) and found.earlier:
            ground = ground._replace(places=frozenset(map(key_of, found.earlier.search.terms)))
        if isinstance(found, Wider):
            terminal.line(ranges_in_words(found), "ranges")
            model, effects = widened(ground.model, effects, found.ranges)
            known = {key_of(t) for t in ground.remembering}  # in their ranges, too
            terms = [t for t in with_memory(model, ground.clean.recording, effects) if key_of(t) in known]
            ground = ground._replace(
                model=model,
                wider=ground.wider + 1,
                earlier=found.earlier or (ground.earlier and ground.earlier._replace(settled=False)),
                simulated=found.simulated or ground.simulated,
                remembering=tuple(terms),
            )
        elif isinstance(found, Finer):
            terminal.line(f"these effects ask for {found.steps} integration steps a row: searching once more", "steps")
            options = replace(ground.options, substeps=found.steps)
            ground = ground._replace(options=options, earlier=found.earlier, finer=True)
        else:
            terminal.line(found.memory.words, "memory")
            ground = ground._replace(
                remembering=found.memory.terms, earlier=found.earlier, simulated=found.simulated or ground.simulated
            )
            effects = found.effects or effects
        found = _search_in_groups(ground, effects)
    last = last_calibration(ground, declared, found.search, found.selection, found.assessor, per_of(found.groupings))
    return found._replace(**last._asdict())


def _search_in_groups(ground: Ground, effects: list[Expression]) -> Searched | First | Again:
    """Search; once more with the effects that differ from group to group, as long as that pays.

    A state that nobody measures may stand for what differs from group to group, which is the simpler cause: it is asked last.
    """
    found, effects = _settled_in_groups(ground, effects)
    if isinstance(found, Again):
        return found._replace(effects=effects)
    if not isinstance(found, Searched) or found.again is None:
        return found
    if ground.budget.over("effects with a state of their own"):
        return found
    return found.again._replace(effects=effects)


def _settled_in_groups(ground: Ground, effects: list[Expression]) -> tuple[Searched | First | Again, list[Expression]]:
    """Do so; also returns the effects as they were searched for in the end."""
    found = _search(ground, effects)
    for _ in range(MOST_GROUPED):
        if not isinstance(found, Searched):
            return found, effects
        grouped = grouped_effects(effects, found.groupings)
        if grouped == effects:
            break
        ungrouped, effects = effects, grouped
        ground.terminal.line("searching once more with it", "groups")
        known = chosen_of(found, found.selection)
        again = _search(ground._replace(earlier=known), effects, [g for g in found.groupings if g.parameter])
        if not isinstance(again, Searched):
            return again, effects
        if not any(again.search.terms[t].groupings for t in again.selection.chosen.terms):
            return found._replace(groupings=confirmed(found.groupings, found.search, found.selection.chosen)), ungrouped
        before = confirmed(found.groupings, again.search, again.selection.chosen)
        each = {(g.subject, g.per): g for g in (*before, *again.groupings)}
        found = again._replace(groupings=list(each.values()))
    return found, effects


def _search(
    ground: Ground, effects: list[Expression], settled: list[Grouping] | None = None
) -> Searched | First | Again:
    """Calibrate the simulator, choose effects, and accept those that help on held-out episodes.

    Args:
        ground: what is searched in.
        effects: that it may lack.
        settled: which of the simulator's parameters differ from group to group; None: that is asked.
    """
    terminal = ground.terminal
    own = settled
    if own is None:
        own = own_parameters(ground.attach(effects), ground.model, ground.options)
        for one in own:
            terminal.line(grouping_in_words(one), "groups")
    while True:
        found = _with(ground, effects, own, ask=settled is None)
        if isinstance(found, Searched | First | Again):
            return found
        own, earlier = found
        settled, ground = own, ground._replace(earlier=earlier)
        for one in own:
            terminal.line(f"beside these effects {grouping_in_words(one)}", "groups")
        terminal.line("searching once more", "groups")


class _Heavy(NamedTuple):
    """A calibration with heavy tails, and what was chosen without them."""

    found: Calibrated
    earlier: Earlier


def _chosen_in(
    found: Calibrated, assessor: Assessor, ground: Ground, unsound: Callable[[Search, Selection], First | None],
    earlier: Earlier | None = None,
) -> tuple[Calibrated, Selection, list[Gate]] | First:  # fmt: skip
    """Search and judge; nothing is judged on held-out episodes in ranges too narrow, steps too coarse, or the wrong noise."""
    options = ground.options

    def wrong(selection: Selection, tails: bool) -> First | _Heavy | None:
        if (first := unsound(found.search, selection)) is not None:
            return _told(first, found, selection)
        heavy = None if not tails or beaten(found.search, selection) else _heavy(found, assessor, selection, ground)
        return None if heavy is None else _Heavy(heavy, chosen_of(found, selection))

    if earlier is not None and earlier.heavy:
        path = path_in(found.search, found.base, earlier)
        found = _with_tails(found, assessor, path[-1] if path else found.base, ground) or found
    while True:
        selection = proposed(found.search, assessor, found.base, options, earlier=earlier)
        outcome = judgement(found.search, assessor, selection, ground.terminal, options.for_ or ONE_STEP, wrong)
        if isinstance(outcome, First):
            return outcome
        if not isinstance(outcome, _Heavy):
            return found, *outcome
        found, earlier = outcome


def _heavy(found: Calibrated, assessor: Assessor, selection: Selection, ground: Ground) -> Calibrated | None:
    """Return the calibration with heavy tails where the noise has them beside a model, and is not known to; else None."""
    # beside what is left unexplained, no data tell whether tails are heavy
    skip = found.degrees_of_freedom or selection.remainder or ground.budget.over("heavy tails of the noise")
    return None if skip else _with_tails(found, assessor, selection.chosen, ground)


def _with_tails(found: Calibrated, assessor: Assessor, trial: Trial, ground: Ground) -> Calibrated | None:
    heavy = with_heavy_tails(found, assessor, trial.optimum.z, ground.terminal)
    if heavy is not None:
        heavy.search.budget = ground.budget
    return heavy


def _told(first: First, found: Calibrated, selection: Selection) -> First:
    """Return what has to be known first, with what was chosen without it; finer steps ask only what stands beside that."""
    return first._replace(earlier=chosen_of(found, selection)._replace(settled=isinstance(first, Finer)))


def chosen_of(found: Calibrated | Searched, selection: Selection) -> Earlier:
    """Return what a search has chosen, for one that is made after it."""
    return Earlier(found.search, selection.chosen, heavy=bool(found.degrees_of_freedom), stages=selection.stages)


def _with(
    ground: Ground, effects: list[Expression], own: list[Grouping], *, ask: bool
) -> Searched | First | Again | tuple[list[Grouping], Earlier]:
    """Search with the parameters of the simulator that differ from group to group.

    Args:
        ground: what is searched in.
        effects: that it may lack.
        own: which parameters differ.
        ask: whether that is asked again beside the effects that were chosen; where others differ then, they are returned.

    Returns:
        the search; or what has to be known before it can be made: wider ranges, or parameters that differ.
    """
    options, terminal, attach = ground.options, ground.terminal, ground.attach(effects)
    declared = ground.model
    model = with_own(declared, per_of(own)) if per_of(own) else declared
    terms = terms_of(model, ground.clean.recording, effects, pairs=options.pairs)
    plan, kept, between_rows = prepared(attach, model, terms, options, terminal, ground.places)

    def wider(search: Search, trial: Trial) -> Wider | None:
        late = ground.wider == MOST_WIDER or (trial.terms and ground.budget.over("wider ranges, beside the effects"))
        return None if late else too_narrow(search, trial)

    def unsound(search: Search, selection: Selection) -> First | None:
        chosen = selection.chosen
        open_ = options.substeps is None or ground.finer
        if open_ and not (chosen.terms and ground.budget.over("finer integration steps")):
            finer = too_coarse(search, assessor, chosen, selection.base)
            if finer is not None:
                return finer
        return wider(search, chosen)

    def fitter(plan: Setup) -> Fitter:
        found = fitter_of(plan, options.lanes, options.room + members(plan))
        found.watch = ground.watch
        return found

    def remembering(levels: NoiseProfile, alone: NoiseProfile) -> tuple[Memory, bool] | None:
        if ground.remembering or ground.budget.over("effects with a state of their own"):
            return None
        return worth_a_search(levels, alone, with_memory(model, ground.clean.recording, effects))

    def begun_in(plan: Setup) -> tuple[Assessor, Calibrated]:
        assessor = Assessor(plan, options.horizon, options.first_rows)
        found = calibrated(plan, fitter(plan), assessor, ground.clean, terminal)
        found.search.budget = ground.budget
        return assessor, found

    assessor, found = begun_in(plan)
    if (ends := wider(found.search, found.base)) is not None:
        # a state that is missing may be what a parameter at the end of its range makes up for
        promising = remembering(at_base := NoiseProfile(found.search, assessor, found.base), at_base)
        return Again(promising[0], None) if promising and promising[0].gain > ends.gain - TIE else ends
    outcome = _chosen_in(found, assessor, ground, unsound, ground.earlier)
    if isinstance(outcome, First):
        return outcome
    found, selection, gates = outcome
    said, chosen = words_of(between_rows), selection.chosen
    if said and chosen.terms and not ground.budget.over("inputs between rows, beside the effects"):
        between_rows = asked_beside(attach, model, found.search, chosen, options.lanes)
    if words_of(between_rows) != said:
        terminal.line(f"beside these effects {in_words(between_rows)}: searching once more", "inputs")
        plan, earlier = attach(saying(model, between_rows), kept=kept), chosen_of(found, selection)
        assessor, found = begun_in(plan)
        outcome = _chosen_in(found, assessor, ground, unsound, earlier)
        if isinstance(outcome, First):
            return outcome
        found, selection, gates = outcome
    if ask and own and selection.chosen.terms and not ground.budget.over("parameters per group, beside the effects"):
        beside = own_parameters(attach, saying(declared, between_rows), options, (found.search, selection.chosen))
        if per_of(beside) != per_of(own):
            return beside, chosen_of(found, selection)
        own = beside  # what it is worth beside the effects
    while True:
        judged = selection.chosen.terms
        selection, gates = accepted(found.search, assessor, selection, gates, terminal, options.for_ or ONE_STEP)
        if selection.chosen.terms and not ground.budget.over("long free runs"):
            runs = windows_for(found.search.plan, ground.clean.recording, FREE_RUN)
            use = options.for_ or ONE_STEP
            selection, gates = harmless(found.search, assessor, selection, gates, runs, terminal, use)
        if selection.chosen.terms != judged and (first := unsound(found.search, selection)) is not None:
            return _told(first, found, selection)
        heavy = _heavy(found, assessor, selection, ground)  # which rivals may have been needed to tell
        if heavy is None:
            break
        outcome = _chosen_in(heavy, assessor, ground, unsound, chosen_of(found, selection))
        if isinstance(outcome, First):
            return outcome
        found, selection, gates = outcome
    search, windows = found.search, found.test
    by_simulations, begun = None, None
    simulate = worth_simulating(search, assessor, selection, options)
    if simulate and not ground.budget.over("a search by simulations"):
        attach_simulated = partial(attach, saying(model, between_rows), kept=kept, simulated=True)
        simulated = simulating(search, selection.base, attach_simulated, fitter)
        assessors = assessor, assessor.of(simulated.plan)
        by_simulations = chosen_by_simulations(
            search, selection, simulated, assessors, options, terminal, wider, ground.simulated
        )
        if isinstance(by_simulations, Wider):
            return by_simulations._replace(earlier=chosen_of(found, selection))
        if by_simulations is not None:
            begun = Earlier(simulated, by_simulations[0].chosen)
            selection, gates = in_rows(simulated, by_simulations[0], search), by_simulations[1]
    outliers = outlier_check(found.clean, plan.augmented.measured)
    terminal.line(outliers.detail, "outliers")
    levels, alone_levels = (NoiseProfile(search, assessor, t) for t in (selection.chosen, selection.base))
    attach_said = partial(attach, saying(model, between_rows))
    # what simulations have chosen need not be worth anything one row ahead: no function may take its place there
    if by_simulations is None and not ground.budget.over("functions of two arguments"):
        selection, gates = with_interactions(levels, alone_levels, selection, gates, attach_said, options, terminal)
        if levels.chosen.terms != selection.chosen.terms:
            levels = NoiseProfile(search, assessor, selection.chosen)
    alone = drifting(alone_levels, (BETWEEN,)) if selection.chosen.terms else None
    again = None
    if (promising := remembering(levels, alone_levels)) is not None:
        again = asked_again(chosen_of(found, selection), *promising, attach_said, options, terminal)
        again = again and again._replace(simulated=begun)
        if again is not None and not model.groups:
            return again
    told = selection.remainder[1] if selection.remainder else 0.0  # nor may a drift take what these explain, and this
    if by_simulations is None and stands_for(alone, selection.base, selection.chosen, told):
        terminal.line("a parameter that is no constant explains as much as these effects", "search")
        selection, gates = cut(search, selection, [])._replace(remainder=None), []
        levels = NoiseProfile(search, assessor, selection.chosen)
    if by_simulations is None and not (selection.chosen.terms and ground.budget.over("effects beside a drift")):
        suspect = suspected(levels, alone_levels, selection)
        needed = [*range(len(selection.chosen.terms))] if suspect is None else needed_beside(
            suspect, attach, saying(model, between_rows), ground.clean.recording, search, selection.chosen, options.lanes
        )  # fmt: skip
        if suspect and (
            idle := [search.terms[t].label for i, t in enumerate(selection.chosen.terms) if i not in needed]
        ):
            terminal.line(f"{suspect.words}: beside that {' and '.join(idle)} earn no place", "search")
            selection, gates = cut(search, selection, needed)._replace(remainder=None), [gates[i] for i in needed]
            levels = NoiseProfile(search, assessor, selection.chosen)
    drift = drifting(levels)
    disturbance = None if selection.remainder else time_dependent_disturbance(levels)
    known = max(selection.remainder[1] if selection.remainder else 0.0, disturbance.gain if disturbance else 0.0)
    if drift is not None and drift.gain < known - TIE:
        drift = None
    if drift is not None:
        terminal.line(f"{drift.words} +{drift.gain:.0f}", "search")
    if disturbance is not None:
        terminal.line(f"a force on {disturbance.acts_on} {disturbance.how} +{disturbance.gain:.0f}", "search")
    left = bool(selection.remainder or disturbance or drift)
    asked = own
    if not (model.groups and ground.budget.over("effects per group")):
        asked = own + groupings(search, assessor, selection, left, effects, attach_said, options, terminal)
    recording = ground.clean.recording
    recording = recording._replace(checks=(*recording.checks, outliers))
    return Searched(
        search, assessor, selection, gates, disturbance, windows, recording, between_rows, found.degrees_of_freedom,
        asked, drift=drift, again=again, by_simulations=by_simulations is not None,
    )  # fmt: skip
