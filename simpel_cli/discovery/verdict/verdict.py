"""The verdict of a search: effect, ambiguous, none or unexplained, as `verdict.json` holds it."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from simpel_cli.data.recording import Check
from simpel_cli.discovery.search.by_group.strangers import assessed
from simpel_cli.discovery.search.gate.held_out import AHEAD, Gate, errors_of, growing
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.share import explained
from simpel_cli.discovery.search.trials import Search, Trial, asked
from simpel_cli.discovery.verdict.aliases import are_aliases, of_structure
from simpel_cli.discovery.verdict.groups import Z90, differing, groups_of
from simpel_cli.discovery.verdict.remainder import left_in_words, noise_of, still_wrong
from simpel_cli.filtering.errors_ahead import Assessment, Assessor, reduction_interval, results, rmse
from simpel_cli.filtering.independent_parts import independent_parts
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import Q_BOUNDS, key_of
from simulators.effects import Term
from simulators.groups import MEMBER, SPREAD

EFFECT, AMBIGUOUS, NONE, UNEXPLAINED = "effect", "ambiguous", "none", "unexplained"
ALL = 0.95  # of the residual
LOST = -20.0  # nats: a fit so far below the simpler model has not converged, and its size has no meaning
SHAKEN = 0.01  # of the typical change in a row: process noise that is worth a word
Z95 = 1.959963984540054


def verdict_of(
    search: Search,
    selection: Selection,
    gates: list[Gate],
    before: Assessment,
    after: Assessment,
    remainder: dict[str, Any] | None,
    windows: Windows,
    checks: tuple[Check, ...],
    horizon: int,
    seconds: float,
    pairs: Sequence[Sequence[tuple[Term, Term]]] = (),
) -> dict[str, Any]:
    """Return `verdict.json`.

    Args:
        search: that was run.
        selection: what it chose; terms that failed the gate are left out already.
        gates: one per chosen term, in order.
        before: the calibrated simulator on the test windows.
        after: the corrected one.
        remainder: the remaining model error (`remainder_of`).
        windows: the test windows.
        checks: of the data.
        horizon: rows.
        seconds: of the search.
        pairs: per chosen term, effects that together these data cannot tell from it.
    """
    chosen = selection.chosen
    effects = [
        _effect(search, selection, i, gates[i] if i < len(gates) else None, pairs[i] if i < len(pairs) else ())
        for i in range(len(chosen.terms))
    ]
    different = [_distinct(e) for e in effects]
    if not effects:
        kind = UNEXPLAINED if remainder else NONE
    else:
        kind = EFFECT if all(len(d) == 1 for d in different) else AMBIGUOUS
    measured = search.plan.augmented.measured
    part = explained(rmse(before.ahead), rmse(after.ahead), np.array(noise_of(search, chosen)[0]))
    if kind == EFFECT and not part.enough(left=remainder is not None):
        kind, remainder = (
            UNEXPLAINED,
            remainder or still_wrong(search, chosen, measured[part.worst], part.times, horizon),
        )
    rows = max(float((windows.ok > 0).any(axis=2).sum()), 1.0)
    errors = {
        words: independent_parts(e, errors_of(after)[words], windows.episode) for words, e in errors_of(before).items()
    }
    ahead = errors[AHEAD["ahead"]]
    interval = reduction_interval(ahead.before, ahead.after, ahead.parts, np.random.default_rng(2))
    first, second, parts = ({words: pair[k] for words, pair in errors.items()} for k in range(3))
    grows = growing(first, second, measured, parts)
    found = {
        "verdict": kind,
        "summary": "",
        "effects": effects,
        "interval": 0.9,
        "remainder": remainder,
        "parameters": _parameters(search, selection.base, chosen),
        "error": {
            "split": "test",
            "episodes": len(np.unique(windows.episode)),
            "unit_note": "RMSE in data units, per measured output",
            "before": results(before, measured, rows),
            "after": results(after, measured, rows),
            "ci95_of_reduction": {n: [float(v) for v in interval[:, j]] for j, n in enumerate(measured)},
            "grows": list(grows),
            "horizon_steps": horizon,
            "surprise": dict(
                zip(measured, (float(v) for v in rmse(after.one_step / np.sqrt(after.variance))), strict=True)
            ),
        },
        "share_explained": part.share,
        "noise_floor": dict(zip(measured, noise_of(search, chosen)[0], strict=True)),
        "process_noise": {
            "before": noise_of(search, selection.base)[1],
            "after": noise_of(search, chosen)[1],
            "share_after": _shaken(search, chosen),
        },
        "integration_steps": search.plan.substeps,
        "gate": [g._asdict() for g in gates],
        "groups": groups_of(
            search, chosen, {o.row: interval_of(search, chosen, o.row) for o in differing(search, chosen)}
        ),
        "not_found": _not_found(search, selection),
        "data_checks": [{"check": c.name, "ok": c.ok, "detail": c.detail} for c in checks],
        "next_experiment": None,
        "determining_experiments": [],
        "corrected_sim": None,
        "candidates_tried": search.tried,
        "seconds": round(seconds, 2),
    }
    warning = f" With it the test error of {' and of '.join(grows)} grows." if grows else ""
    return found | {"summary": sentence(found, before, after, measured) + warning}


def steps_of(
    search: Search, selection: Selection, assessor: Assessor, windows: Windows, for_use: Callable[[Trial], Trial]
) -> list[dict[str, Any]]:
    """Return the errors on the test windows after each accepted effect, from the calibrated simulator on."""
    measured = search.plan.augmented.measured
    rows = max(float((windows.ok > 0).any(axis=2).sum()), 1.0)
    steps, before = [], set[int]()
    for trial in selection.path:
        added = [search.terms[t].label for t in trial.terms if t not in before]
        before = set(trial.terms)
        found = assessed(search, assessor, trial, windows, for_use)
        steps.append({"added": added, "error": results(found, measured, rows)})
    return steps


def interval_of(search: Search, trial: Trial, row: int, z: float = Z90) -> dict[str, float]:
    """Return value and 90 % interval of one unknown of a fit, in its unit; z: half width in standard deviations."""
    coordinates, optimum = search.plan.coordinates, trial.optimum
    at, sd = float(optimum.z[row]), 0.0
    if row in optimum.free:
        i = optimum.free.index(row)
        at, sd = float(np.clip(optimum.centre[i], 0, 1)), float(np.sqrt(optimum.covariance[i, i]))
    low, high = (float(np.clip(at + s * z * sd, 0, 1)) for s in (-1, 1))
    return {
        "value": coordinates.value(row, at),
        "low": coordinates.value(row, low),
        "high": coordinates.value(row, high),
    }


def before_of(search: Search, base: Trial, row: int) -> dict[str, float]:
    """Return `interval_of` of a parameter of the simulator as it was declared: nothing of it lies outside its range."""
    ends = search.declared.get(search.plan.augmented.params[row].name, (-np.inf, np.inf))
    return {name: float(np.clip(value, *ends)) for name, value in interval_of(search, base, row).items()}


def _effect(
    search: Search, selection: Selection, i: int, gate: Gate | None, pairs: Sequence[tuple[Term, Term]]
) -> dict[str, Any]:
    term = search.terms[selection.chosen.terms[i]]
    rows = search.rows[selection.chosen.terms[i]]
    others = [(search.terms[t.terms[-1]], t) for t in selection.classes[i]]
    own = (selection.chosen.terms[i], selection.chosen)
    alike = {key_of(other) for other, t in others if are_aliases(search, selection.chosen, own, (t.terms[-1], t))}
    structural = of_structure(search, term)
    alike |= {key_of(t) for t in structural}
    every = {key_of(t): t for t in (*(t for t, _ in others), *structural)}
    members = [{"name": term.effect, "acts_on": term.acts_on, "same": True}] + [
        {"name": t.effect, "acts_on": t.acts_on, "same": key in alike or t.effect in term.same_as}
        for key, t in every.items()
    ]
    same = [t.effect for key, t in every.items() if key in alike and t.effect != term.effect]
    places = {m["name"]: m["acts_on"] for m in members[::-1]}
    before = noise_of(search, selection.path[0])[1]  # with groups, where parameters differ
    after = noise_of(search, selection.chosen)[1]
    return {
        "name": term.effect,
        "acts_on": term.acts_on,
        "meaning": term.meaning,
        "class": list(dict.fromkeys(m["name"] for m in members)),
        "class_acts_on": places,
        "class_members": members,
        "same_as": list(dict.fromkeys([*term.same_as, *same])),
        "same_as_two": [[{"name": t.effect, "acts_on": t.acts_on} for t in pair] for pair in pairs],
        "log_evidence_gain": selection.gains[i],
        "held_out_gain": None if gate is None else gate._asdict(),
        "parameters": {
            parameter.label: interval_of(search, selection.chosen, row) | {"unit": parameter.unit}
            for parameter, row in zip(term.parameters, rows, strict=True)
        },
        "share_of_residual": float(1 - (after / before) ** 2) if before > 0 else 0.0,
    }


def _distinct(effect: dict[str, Any]) -> list[str]:
    """Names of a class that some data could distinguish, with the place where a name has several."""
    first, *others = effect["class_members"]
    return _labels(effect, [first, *(m for m in others if not m["same"])])


def _labels(effect: dict[str, Any], members: list[dict[str, Any]]) -> list[str]:
    """Members of a class in words; with the place where a name acts on several."""
    names = [m["name"] for m in effect["class_members"]]
    words = [(m["name"].replace("_", " "), names.count(m["name"]) > 1, m["acts_on"]) for m in members]
    return list(dict.fromkeys(f"{name} on {place}" if several else name for name, several, place in words))


def _parameters(search: Search, base: Trial, chosen: Trial) -> dict[str, Any]:
    return {
        q.name: {"before": before_of(search, base, i), "after": interval_of(search, chosen, i), "unit": q.unit}
        for i, q in enumerate(search.plan.augmented.model.params)
        if q.role not in (SPREAD, MEMBER)
    }


def _shaken(search: Search, trial: Trial) -> float:
    """Return the largest process noise in a row over the typical change of its state in a row."""
    coordinates = search.plan.coordinates
    n_p, n_r, n_q = coordinates.sizes
    rows = range(n_p + n_r, n_p + n_r + n_q)
    return max(
        (coordinates.value(i, trial.optimum.z[i]) / coordinates.value(i, 1.0) * Q_BOUNDS[1] for i in rows), default=0
    )


def _not_found(search: Search, selection: Selection) -> list[dict[str, Any]]:
    """Return the smallest detectable size of every other effect: with it the effect would have been accepted."""
    last = selection.stages[-1]
    if last.before.terms != selection.chosen.terms:
        return []
    seen: list[tuple[int, float, float | None]] = [(t, sd, None) for t, sd in last.screened]
    for trial in last.trials:
        gain = trial.optimum.log_evidence - last.before.optimum.log_evidence
        i = trial.optimum.free.index(search.rows[trial.terms[-1]][0])
        if gain > LOST:
            seen.append((trial.terms[-1], float(np.sqrt(trial.optimum.covariance[i, i])), float(gain)))
    rows = []
    for t, sd, earned in seen:
        term, row = search.terms[t], search.rows[t][0]
        occam = max(-np.log(sd * np.sqrt(2 * np.pi)), 0.0)
        size = sd * np.sqrt(2 * (asked(len(selection.chosen.terms) + 1) + occam))
        span = search.plan.coordinates.high[row] - search.plan.coordinates.low[row]
        if size < 1 and not term.depends_on:
            parameter = term.parameters[0]
            rows.append(
                {"name": term.effect, "acts_on": term.acts_on, "parameter": parameter.label,
                 "smallest_detectable": float(size * span), "unit": parameter.unit, "log_evidence_gain": earned}
            )  # fmt: skip
    return sorted(rows, key=lambda row: (row["name"], row["acts_on"]))


def sentence(found: dict[str, Any], before: Assessment, after: Assessment, measured: tuple[str, ...]) -> str:
    """Return the verdict as one sentence with numbers and units."""
    first, second = rmse(before.ahead), rmse(after.ahead)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = first / second
    best = int(np.nanargmax(ratio)) if np.isfinite(ratio).any() else 0
    steps = found["error"]["horizon_steps"]
    goes = "falls" if second[best] < first[best] else "does not fall: it goes"
    gain = f"The test error {steps} rows ahead in {measured[best]} {goes} from {first[best]:.3g} to {second[best]:.3g}."
    if not np.isfinite(ratio).any():
        gain = (
            f"No test episode is longer than {steps} rows, so the error so far ahead is not known (discovery.horizon)."
        )
    parts, share = [_phrase(e) for e in found["effects"]], float(np.nan_to_num(max(found["share_explained"], 0.0)))
    listed = " and ".join(parts)
    rest = f" {left_in_words(found['remainder'])}." if found["remainder"] else ""
    match found["verdict"]:
        case "effect":
            told = np.isfinite(found["share_explained"]) and share < ALL
            much = f"{share:.0%} of the model error" if told else "the residual"
            return f"{listed[0].upper()}{listed[1:]} explain{'s' if len(parts) == 1 else ''} {much}. {gain}{rest}"
        case "ambiguous":
            tied = next(e for e in found["effects"] if len(_distinct(e)) > 1)
            names = ", or ".join([" or ".join(_distinct(tied)), *_pairs(tied)])
            also = (
                f" Also found: {' and '.join(_phrase(e) for e in found['effects'] if e is not tied)}."
                if len(parts) > 1
                else ""
            )
            return f"Causes that fit these data equally well: {names}.{also} {gain}{rest}"
        case "unexplained":
            also = f" Found on the way, {share:.0%} of it: {listed}. {gain}" if parts else ""
            return f"No known effect explains the model error: {found['remainder']['description']}.{also}"
        case _:
            text = "No missing effect was found: the calibrated simulator explains these data"
            if not np.array_equal(first, second, equal_nan=True):
                where = " where parameters differ" if found["groups"] else ""
                text = f"{text}{where}. {gain.removesuffix('.')}"
            if found["process_noise"]["share_after"] < SHAKEN:
                return f"{text}."
            return (
                f"{text}, except for white noise in the rates ({found['process_noise']['after']:.2g} per square root of a "
                "second): random disturbances, or an effect that changes faster than the sampling can show."
            )


def _phrase(effect: dict[str, Any]) -> str:
    values = ", ".join(
        f"{name} = {p['value']:.3g} ({p['low']:.3g}..{p['high']:.3g}) {p['unit']}"
        for name, p in effect["parameters"].items()
    )
    aliases = _labels(effect, [m for m in effect["class_members"][1:] if m["same"]])
    also = f", in this model the same as {' and '.join(aliases)}" if aliases else ""
    pairs = _pairs(effect)
    two = f" (which these data cannot tell from {', or from '.join(pairs)})" if pairs else ""
    return f"{effect['name'].replace('_', ' ')} on {effect['acts_on']} ({values}){also}{two}"


def _pairs(effect: dict[str, Any]) -> list[str]:
    """Return in words the two effects that do as well as one; pairs with the same first, and place of the second, are one."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for first, second in effect["same_as_two"]:
        one = f"{first['name'].replace('_', ' ')} on {first['acts_on']}"
        grouped.setdefault((one, second["acts_on"]), []).append(second["name"].replace("_", " "))
    return [
        f"{first} with {' or '.join([', '.join(names[:-1]), names[-1]] if names[1:] else names)} on {place}"
        for (first, place), names in grouped.items()
    ]
