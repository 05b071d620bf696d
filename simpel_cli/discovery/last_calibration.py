"""The last step of a search: its models, calibrated for what they will be used for (`discovery.for`)."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from simpel_cli.discovery.ground import Ground
from simpel_cli.discovery.search.by_group.own_parameters import in_common, spreads_in
from simpel_cli.discovery.search.ranges import narrowed, translated, within
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.uses import (
    MOST_ROWS_OF_STEP,
    ONE_STEP,
    calibrated_for,
    in_words,
    suited,
    windows_for,
)
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.initial_states import begun
from simpel_cli.filtering.measurements.windows import Windows
from simulators.model import Model

LATE = "whether a calibration for the use does as well on other episodes; steps before the last"


class Last(NamedTuple):
    """What a search comes to, for what it is for; fields of `Searched`.

    Args:
        selection: the models before and after.
        wider: nats by which the evidence of the chosen model is ahead of that within the ranges that were declared.
        for_use: calibrates another model of the search so.
    """

    selection: Selection
    wider: float
    for_use: Callable[[Trial], Trial]


def _made_up(selection: Selection, ahead: float) -> bool:
    """Whether a range is wider for what is left unexplained alone: its end made up for a part of that, and is no finding.

    Where effects were found, a wider range had to earn its place beside them.

    Args:
        selection: what was chosen.
        ahead: nats that it is ahead of the same in the ranges that were declared.
    """
    return not selection.chosen.terms and selection.remainder is not None and ahead < selection.remainder[1]


def last_calibration(
    ground: Ground, declared: Model, search: Search, selection: Selection, assessor: Assessor, per: Mapping[str, str]
) -> Last:
    """Calibrate the models before and after for their use.

    Before is the simulator as it was declared: one value for all groups, in the ranges that it gives.

    Args:
        ground: what was searched in.
        declared: the simulator, in the ranges that it gives.
        search: in wider ranges, maybe.
        selection: what it has chosen.
        assessor: of errors ahead.
        per: parameters of the simulator that differ from group to group.
    """
    use = ground.options.for_ or ONE_STEP
    base = in_common(search, selection.base, spreads_in(search, per)) if per else selection.base
    narrow = narrowed(search, {q.name: (q.low, q.high) for q in declared.params})
    wider, path, at_home = 0.0, selection.path, search  # in whose ranges what was chosen stays
    if narrow is not None:
        base, given = within(search, narrow, base), {q.name: (q.low, q.high) for q in declared.params}
        chosen = within(search, narrow, selection.chosen)
        ahead = selection.chosen.optimum.log_evidence - chosen.optimum.log_evidence
        if _made_up(selection, ahead):
            path, at_home = (chosen,), narrow
        else:
            own = search.plan.augmented.model.params
            ends_of = {q.name: given.get(q.name, (q.low, q.high)) for q in own}
            search.declared = {q.name: ends_of[q.name] for q in own if ends_of[q.name] != (q.low, q.high)}
            wider = ahead

    def as_searched(within_these: Search | None, trial: Trial) -> Trial:
        return trial if within_these is None or within_these is search else translated(within_these, search, trial)

    def told(base: Trial, path: tuple[Trial, ...]) -> Selection:
        base, *steps = as_searched(narrow, base), *(as_searched(at_home, trial) for trial in path)
        return selection._replace(base=base, chosen=steps[-1], path=tuple(steps))

    if use == ONE_STEP:
        return Last(told(base, path), wider, lambda trial: trial)

    def of_use(search: Search, trial: Trial, calibration: Callable[..., Trial], windows: Windows) -> Trial:
        own = assessor.of(search.plan)
        return calibration(search, own, trial, begun(own, trial.optimum.z, windows), use)

    recording, before = ground.clean.recording, path[-1]
    whole, part = (windows_for(search.plan, recording, use, *most) for most in ((), (MOST_ROWS_OF_STEP,)))
    late = ground.budget.over(LATE)
    ends = (narrow or search, base), (at_home, before)
    base, chosen = (of_use(own, trial, calibrated_for if late else suited, whole) for own, trial in ends)
    if chosen is not before:  # what is between follows the last
        others = path[:1] if late else path[:-1]
        path = (*(of_use(at_home, t, calibrated_for, part) for t in others if t is not before), chosen)
    dt = search.plan.augmented.model.dt
    ground.terminal.line(in_words(use, whole, dt, moved=chosen is not before), "search")
    return Last(told(base, path), wider, lambda trial: of_use(search, trial, calibrated_for, whole))
