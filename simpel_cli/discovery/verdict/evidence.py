"""Tables of a search: latent forces, simulated episodes, one-step errors and effects of the models before and after.

Three models are compared. `before`: the simulator, calibrated. `after`: with the effects that were found. `without`: the
parameters of `after`, the effects switched off; its latent force is the part that the effects have to explain, with all
other parameters equal. Latent forces of all three are smoothed with the process noise of `before`: the corrected model has
hardly any of its own, so that its latent force would be zero by assumption.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import Search
from simpel_cli.discovery.verdict.tables import (
    Columns,
    as_columns,
    candidate_columns,
    column_names,
    error_columns,
    innovation_columns,
    joined,
    parameter_columns,
    residual_columns,
    trajectory_columns,
)
from simpel_cli.filtering.errors_ahead import Assessment, Assessor
from simpel_cli.filtering.likelihood.latent_force import Forces
from simpel_cli.filtering.measurements.windows import Windows
from simulators.effects import Term
from simulators.effects.term import OPERATORS, SENSOR
from simulators.effects.units import per
from simulators.expression import symbols_used
from simulators.groups import slots_of
from simulators.model import Model

BEFORE, WITHOUT, AFTER = "before", "without", "after"
GRID = 101  # points of an effect's curve


class EvidenceTable(NamedTuple):
    """A table: columns, and the units of those that no other column gives."""

    columns: Columns
    units: dict[str, str]


def evidence_tables(
    search: Search,
    selection: Selection,
    assessor: Assessor,
    recording: Recording,
    windows: Windows,
    before: Assessment,
    after: Assessment,
) -> dict[str, EvidenceTable]:
    """Return the tables of a search by the names of their files.

    Args:
        search: that was run.
        selection: what it chose.
        assessor: of its models.
        recording: the measurements.
        windows: of the test episodes.
        before: the calibrated simulator on them.
        after: the corrected one.
    """
    plan = search.plan
    model = plan.augmented.model
    units = {q.name: q.unit for q in (*model.states, *model.inputs, *model.outputs)}
    measured = {name: units[name] for name in plan.augmented.measured}
    n_p, n_r, _ = plan.coordinates.sizes
    noise = {
        name: plan.coordinates.value(n_p + j, float(selection.chosen.optimum.z[n_p + j]))
        for j, name in enumerate(measured)
    }
    chosen, base = selection.chosen.optimum.z, selection.base.optimum.z
    off = search.off(chosen, selection.chosen.terms)
    vectors = {BEFORE: base}
    if not np.array_equal(chosen, base):
        loud = [np.concatenate([z[: n_p + n_r], base[n_p + n_r :]]) for z in (off, chosen)]
        vectors |= {WITHOUT: loud[0], AFTER: loud[1]}
    splits: dict[str, tuple[Windows, Sequence[Episode]]] = {
        "train": (plan.windows, recording.train),
        "test": (windows, recording.test),
    }
    arguments = (
        column_names([q.name for q in model.states]),
        column_names([q.name for q in model.inputs]),
    )
    driven = {i: (model.states[i].name, per(model.states[i].unit, "s")) for i in plan.coordinates.driven}
    turns = np.array([q.periodic for q in model.states])
    forces = Forces(plan.rule, plan.coordinates, model.dt)
    residuals, innovations = [], []
    for split, (cut, episodes) in splits.items():
        for name, z in vectors.items():
            force = forces(z, assessor(z, cut).track, cut)
            with_effect, without = (forces.following(v, force.state, cut) for v in (chosen, off))
            effect = (with_effect - without)[:, :-1] / model.dt
            force = force._replace(state=np.where(turns, np.angle(np.exp(1j * force.state)), force.state))
            residuals.append(residual_columns(name, split, force, effect, cut, episodes, driven, arguments))
        pair = (before, after) if split == "test" else (assessor(base, cut), assessor(chosen, cut))
        for name, found in zip((BEFORE, AFTER), pair, strict=True):
            innovations.append(innovation_columns(name, split, found, cut, episodes, tuple(measured)))
    residual = joined(residuals)
    names = dict(zip([*arguments[0], *arguments[1]], [*model.states, *model.inputs], strict=True))
    span = {q.name: residual[column] for column, q in names.items()}
    slots = _slots(model)
    names = {column: q for column, q in names.items() if q.name not in slots}
    residual = {column: values for column, values in residual.items() if column not in slots}
    return {
        "residuals": EvidenceTable(residual, {"time": "s"} | {column: q.unit for column, q in names.items()}),
        "effect_curves": EvidenceTable(_curves(search, selection, span), {}),
        "innovations": EvidenceTable(joined(innovations), {"time": "s"}),
        "trajectories": EvidenceTable(
            trajectory_columns(before, after, windows, recording.test, measured), {"time": "s"}
        ),
        "errors": EvidenceTable(error_columns(before, after, windows, measured, noise), {}),
        "parameters": EvidenceTable(parameter_columns(search, selection), {}),
        "candidates": EvidenceTable(candidate_columns(search, selection), {"log_evidence_gain": "nat", "asked": "nat"}),
        "coverage": EvidenceTable(_coverage(search, recording), {}),
    }  # fmt: skip


def _curves(search: Search, selection: Selection, span: dict[str, np.ndarray]) -> Columns:
    """Return the curve of every effect along each of its arguments, the other quantities at their median.

    An effect with memory, on a sensor or of the model's own rate has no such curve.
    """
    augmented, coordinates = search.plan.augmented, search.plan.coordinates
    chosen = selection.chosen
    n_p = coordinates.sizes[0]
    model = augmented.model
    middle = {name: float(np.nanmedian(values)) for name, values in span.items()}
    neutral = np.array(
        [coordinates.value(i, z) for i, z in enumerate(search.off(chosen.optimum.z, chosen.terms)[:n_p])]
    )
    rows = []
    for t in chosen.terms:
        term: Term = search.terms[t]
        if term.kind in OPERATORS or term.kind == SENSOR:
            continue
        p = neutral.copy()
        for i in search.rows[t]:
            p[i] = coordinates.value(i, float(chosen.optimum.z[i]))
        used = set().union(*(symbols_used(e) for e in (term.rates or term.inputs).values()))
        for argument in [name for name in span if name in used]:
            values = np.linspace(np.nanmin(span[argument]), np.nanmax(span[argument]), GRID)
            at = middle | {argument: values}
            x, u = (
                np.stack([np.broadcast_to(at[q.name], GRID) for q in group]) if group else np.zeros((0, GRID))
                for group in (model.states, model.inputs)
            )
            on, off = (np.asarray(augmented.function(x, u, np.tile(v[:, None], GRID))[0]) for v in (p, neutral))
            for i in coordinates.driven:
                if np.any(on[i] != off[i]):
                    rows += [
                        {"effect": term.effect, "on": term.acts_on, "argument": argument,
                         "acts_on": model.states[i].name, "unit": per(model.states[i].unit, "s"),
                         "value": float(v), "force": float(f)}
                        for v, f in zip(values, on[i] - off[i], strict=True)
                    ]  # fmt: skip
    if not rows:
        names = ("effect", "on", "argument", "acts_on", "unit")
        return {n: np.array([], str) for n in names} | {n: np.array([], float) for n in ("value", "force")}
    return as_columns(rows)


def _slots(model: Model) -> set[str]:
    """Return the names of the inputs that say which group a row is of: no force is a function of them."""
    return {model.inputs[j].name for of in slots_of(model) for j in of}


def _coverage(search: Search, recording: Recording) -> Columns:
    """Return the span of every measured state and input in the training data, beside its declared range."""
    model = search.plan.augmented.model
    states = np.concatenate([e.states for e in recording.train])
    inputs = np.concatenate([e.inputs for e in recording.train])
    slots = _slots(model)  # which group a row is of has no range
    rows = []
    # what effects bring along stands last, and has no column
    for values, group in ((states, model.states[: states.shape[1]]), (inputs, model.inputs)):
        for j, q in enumerate(group):
            if q.name in recording.estimated or q.name in slots or not np.isfinite(values[:, j]).any():
                continue
            column = np.angle(np.exp(1j * values[:, j])) if q.periodic else values[:, j]
            rows.append(
                {
                    "quantity": q.name, "unit": q.unit, "low": float(np.nanmin(column)), "high": float(np.nanmax(column)),
                    "range_low": q.low, "range_high": q.high, "periodic": q.periodic,
                }
            )  # fmt: skip
    return as_columns(rows)
