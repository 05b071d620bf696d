"""Effects that were chosen for what a parameter that is no constant does.

Where a parameter drifts, a search finds effects that do a part of what the drift does. So they are fitted once more beside it,

    d(x)/dt = f(x, u, p + c (t/T - 1/2))  over an episode of length T,

in a small program, of which t/T - 1/2 is an input. What earns no place there was chosen for the drift.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi
import numpy as np

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.smaller import carried_windows, fitted_again, small_search
from simpel_cli.discovery.search.trials import TIE, Search, Trial
from simpel_cli.discovery.search.unexplained.drifts import OVER, Drift, drifting, may_stand_for
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import Setup, key_of, members
from simulators.expression import Symbol
from simulators.groups import slots_of
from simulators.model import Model
from simulators.quantity import Quantity

PROGRESS, SIZE = "progress_of_the_episode", "drift_of_"


def with_drift(model: Model, parameter: str) -> Model:
    """Return the simulator of which a parameter changes by `drift_of_PARAMETER` from the begin of an episode to its end."""
    place = [q.name for q in model.params].index(parameter)
    q, own, before = model.params[place], len(model.params), _before_groups(model)
    span = q.high - q.low
    change = Quantity(f"{SIZE}{parameter}", q.unit, -span, span)

    def at(u: Symbol, p: Symbol) -> tuple[Symbol, Symbol]:
        moved = p[:own]
        moved[place] = p[place] + p[own] * u[before]
        return casadi.vertcat(u[:before], u[before + 1 :]), moved

    def rhs(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return model.rhs(x, *at(u, p))

    def output(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return model.output(x, *at(u, p))

    inputs = (*model.inputs[:before], Quantity(PROGRESS, "1", -0.5, 0.5), *model.inputs[before:])
    return replace(
        model, params=(*model.params, change), inputs=inputs, rhs=rhs, output=output,
        covariates=model.covariates | {PROGRESS: PROGRESS},
    )  # fmt: skip


def with_progress(recording: Recording, model: Model) -> Recording:
    """Return measurements of a model with an input more: how far every row is in its episode, from -1/2 to 1/2."""
    before = _before_groups(model)

    def further(e: Episode) -> Episode:
        passed = e.time - e.time[0]
        return e._replace(inputs=np.insert(e.inputs, before, passed / max(float(passed[-1]), 1e-300) - 0.5, axis=1))

    train, test = (tuple(map(further, part)) for part in (recording.train, recording.test))
    return recording._replace(train=train, test=test)


def _before_groups(model: Model) -> int:
    """Return the number of inputs in front of those that say of which group a row is."""
    return len(model.inputs) - sum(len(slots) for slots in slots_of(model))


def suspected(levels: NoiseProfile, alone: NoiseProfile, selection: Selection) -> Drift | None:
    """Return the drift over every episode that may stand for chosen effects: beside them, or in their place.

    Args:
        levels: of the chosen model.
        alone: of the simulator.
        selection: what was chosen.
    """
    if not selection.chosen.terms:
        return None
    instead = drifting(alone, (OVER,))
    instead = instead if may_stand_for(instead, selection.base, selection.chosen) else None
    found = drifting(levels, (OVER,)) or instead
    # where a function that a gate has accepted explains more, effects are not judged without it
    known = selection.remainder[1] if selection.remainder else 0.0
    return None if found is None or found.gain < known - TIE else found


def needed_beside(
    drift: Drift, attach: Callable[..., Setup], model: Model, recording: Recording, search: Search, chosen: Trial,
    side_by_side: int,
) -> list[int]:  # fmt: skip
    """Return the places of the chosen effects that earn their place beside a drift.

    Args:
        drift: a parameter that drifts over every episode. It has to do as well as the effects that go.
        attach: (model, recording, kept) -> the setup of a program with these terms alone.
        model: in which the effects were chosen.
        recording: its measurements.
        search: in which they were chosen.
        chosen: they.
        side_by_side: fits that run side by side.
    """
    kept = frozenset(key_of(search.terms[t]) for t in chosen.terms)
    given: dict[str, Any] = {"recording": with_progress(recording, model), "kept": kept}
    plan = attach(with_drift(model, drift.parameter), **given)
    windows = carried_windows(search.plan, plan)._replace(u=plan.windows.u)
    plan = plan._replace(windows=windows, spare=None)
    small = small_search(plan, side_by_side, sum(len(search.all_rows(t)) for t in chosen.terms) + members(plan))
    together = fitted_again(small, search, chosen)
    row = len(model.params)
    constant = small.loud(together.optimum.z)
    constant[row] = plan.start[row]
    unmoved = tuple(i for i in together.optimum.free if i != row)
    (alone,) = small.fitter([Hypothesis(constant, unmoved, small.ones)])
    beside, *_ = small.prune(together)
    if beside.optimum.log_evidence < alone.log_evidence - TIE:
        return list(range(len(chosen.terms)))
    left = {key_of(small.terms[t]) for t in beside.terms}
    return [i for i, t in enumerate(chosen.terms) if key_of(search.terms[t]) in left]
