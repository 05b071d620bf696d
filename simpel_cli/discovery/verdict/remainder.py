"""Model error after the search: an unknown function, a time-dependent disturbance, or autocorrelated errors."""

from typing import Any

import numpy as np

from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.dependent_parameters import label_of
from simpel_cli.discovery.search.unexplained.disturbances import Disturbance
from simpel_cli.discovery.search.unexplained.drifts import OVER, Drift
from simpel_cli.discovery.search.unexplained.function_screening import changed_by
from simpel_cli.filtering.errors_ahead import Assessment
from simpel_cli.filtering.likelihood.augmented import augment
from simpel_cli.filtering.likelihood.whiteness import memory
from simulators.effects import Term
from simulators.effects.term import PARAMETER
from simulators.effects.units import per

ALIKE = 0.3  # of an input's variance, at the period of a disturbance


def remainder_of(
    search: Search,
    selection: Selection,
    disturbance: Disturbance | None,
    learnt: Assessment,
    drift: Drift | None = None,
) -> dict[str, Any] | None:
    """Return `remainder` of `verdict.json`; None if no model error is found.

    Args:
        search: that was run.
        selection: what it chose, and an unknown function that improves it further.
        disturbance: a force that depends on time alone; None: there is none.
        learnt: the corrected model on the windows that it was fitted to.
        drift: a parameter that is no constant, which explains more than either; None: there is none.
    """
    if drift is not None:
        return _of_parameter(search, selection.chosen, drift)
    found = _function(search, selection) or (disturbance and _of_time(search, disturbance))
    return found or _followed(search, selection.chosen, learnt)


def still_wrong(search: Search, chosen: Trial, worst: str, times: float, horizon: int) -> dict[str, Any]:
    """Describe errors that stay far above the noise, of which nothing else is known."""
    return {
        "acts_on": worst,
        "depends_on": [],
        "rms": noise_of(search, chosen)[1] / np.sqrt(search.plan.augmented.model.dt),
        "unit": _unit(search, worst),
        "log_evidence_gain": None,
        "description": f"the errors of {worst} {horizon} rows ahead stay {times:.2g} times as large as its noise, and no "
        "function of the states and inputs that was tried explains the rest",
    }


def left_in_words(remainder: dict[str, Any]) -> str:
    """Return what remains beside the effects, as a sentence without its full stop."""
    if "parameter" in remainder:
        return remainder["description"][0].upper() + remainder["description"][1:]
    return f"The remaining model error depends on {dependence(remainder)}"


def dependence(remainder: dict[str, Any]) -> str:
    """Return what the remaining model error depends on, in words."""
    period = remainder.get("period")
    return ", ".join(remainder["depends_on"]) + (f", with a period of about {period:.3g} s" if period else "")


def _of_parameter(search: Search, chosen: Trial, drift: Drift) -> dict[str, Any]:
    return {
        "acts_on": drift.acts_on,
        "depends_on": ["time" if drift.how == OVER else "episode"],
        "rms": noise_of(search, chosen)[1] / np.sqrt(search.plan.augmented.model.dt),
        "unit": _unit(search, drift.acts_on),
        "log_evidence_gain": drift.gain,
        "parameter": drift.parameter,
        "description": f"a parameter is no constant: {drift.words}",
    }


def _function(search: Search, selection: Selection) -> dict[str, Any] | None:
    if selection.remainder is None:
        return None
    term, gain = selection.remainder
    if term.kind == PARAMETER:
        return _dependent(search, selection.chosen, term, gain)
    scale = search.plan.scales.rate[term.acts_on]
    level = noise_of(search, selection.chosen)[1]
    unit = term.parameters[0].unit
    return {
        "acts_on": term.acts_on,
        "depends_on": list(term.depends_on),
        "rms": level / np.sqrt(search.plan.augmented.model.dt),
        "unit": unit,
        "log_evidence_gain": gain,
        "description": f"an unknown function of {', '.join(term.depends_on)} acts on d({term.acts_on})/dt "
        f"(typical rate in the data: {scale:.3g} {unit})",
    }


def _dependent(search: Search, chosen: Trial, term: Term, gain: float) -> dict[str, Any]:
    """Describe a parameter that depends on a state or an input."""
    effects, scales = [search.terms[t] for t in chosen.terms], search.plan.scales
    changed = changed_by(augment(search.plan.augmented.model, [*effects, term], search.plan.augmented.measured), term)
    acts_on = max(changed, key=lambda name: changed[name] / scales.rate[name])
    return {
        "acts_on": acts_on,
        "depends_on": list(term.depends_on),
        "rms": noise_of(search, chosen)[1] / np.sqrt(search.plan.augmented.model.dt),
        "unit": _unit(search, acts_on),
        "log_evidence_gain": gain,
        "parameter": label_of(term.acts_on, effects),
        "description": f"a parameter is no constant: {term.meaning}",
    }


def _of_time(search: Search, disturbance: Disturbance) -> dict[str, Any]:
    return {
        "acts_on": disturbance.acts_on,
        "depends_on": ["time"],
        "rms": disturbance.rms,
        "unit": _unit(search, disturbance.acts_on),
        "log_evidence_gain": disturbance.gain,
        "period": disturbance.period,
        "description": f"a disturbance acts on d({disturbance.acts_on})/dt, or on its sensor, "
        f"that {disturbance.how}{_like(search, disturbance.period)}",
    }


def _like(search: Search, period: float | None) -> str:
    """Name the inputs that have the same period: the disturbance may be a function of them."""
    if period is None:
        return ""
    model, plan = search.plan.augmented.model, search.plan
    rows = plan.windows.ok.shape[1]
    u = plan.windows.u[:, plan.lead : plan.lead + rows]
    phase = 2 * np.pi * model.dt / period * np.arange(rows)
    waves = np.stack([np.ones(rows), np.cos(phase), np.sin(phase)], axis=1)
    left = u - np.einsum("tk,wkj->wtj", waves, np.linalg.pinv(waves) @ u)
    spread = ((u - u.mean(axis=1, keepdims=True)) ** 2).sum(axis=(0, 1))
    names = [q.name for q, all_of_it, rest in zip(model.inputs, spread, (left**2).sum(axis=(0, 1)), strict=True)
             if rest < (1 - ALIKE) * all_of_it]  # fmt: skip
    return f", the same as that of {' and '.join(names)}: possibly a function of the input" if names else ""


def _unit(search: Search, state: str) -> str:
    """Return the unit of a state's rate."""
    return next((per(q.unit, "s") for q in search.plan.augmented.model.states if q.name == state), "")


def _followed(search: Search, chosen: Trial, learnt: Assessment) -> dict[str, Any] | None:
    """Describe a disturbance that no candidate explains but that the filter follows; None if there is none."""
    errors = learnt.one_step / np.sqrt(learnt.variance)
    found = {
        name: correlated
        for j, name in enumerate(search.plan.augmented.measured)
        if (correlated := memory(errors[:, :, j])) is not None
    }
    if not found:
        return None
    worst = max(found, key=lambda name: abs(found[name][0]))
    r, lag = found[worst]
    apart = "from row to row" if lag == 1 else f"at a distance of {lag} rows"
    model, roles = search.plan.augmented.model, search.plan.augmented.roles
    speed = {position: velocity for velocity, position in roles.velocity.items() if position}
    acts_on = speed.get(worst, worst)
    return {
        "acts_on": acts_on,
        "depends_on": ["time"],
        "rms": noise_of(search, chosen)[1] / np.sqrt(model.dt),
        "unit": _unit(search, acts_on),
        "log_evidence_gain": None,
        "description": f"a disturbance acts on d({acts_on})/dt that is not a function of the states and inputs: the one-step "
        f"errors of {worst} are autocorrelated (correlation {r:.2f} {apart}); it depends on time, or on a quantity that was "
        "not recorded",
    }


def noise_of(search: Search, trial: Trial) -> tuple[list[float], float]:
    """Measurement noise per channel, and the largest process noise, per square root of a second."""
    n_p, n_r, n_q = search.plan.coordinates.sizes
    r, q = (
        [search.plan.coordinates.value(i, trial.optimum.z[i]) for i in rows]
        for rows in (range(n_p, n_p + n_r), range(n_p + n_r, n_p + n_r + n_q))
    )
    return r, max(q, default=0.0)
