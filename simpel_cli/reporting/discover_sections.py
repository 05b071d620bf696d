"""The sections of the report of a search, made from the verdict and the tables only."""

import difflib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.discovery.search.trials import ACCEPT, FURTHER
from simpel_cli.discovery.verdict.remainder import dependence
from simpel_cli.filtering.measurements.windows import LEAST_EPISODES
from simpel_cli.reporting.equations import of_sensors
from simpel_cli.reporting.figures import draw_discover
from simpel_cli.reporting.figures.canvas import with_interval, with_unit
from simpel_cli.reporting.figures.discover_runs import models_of
from simpel_cli.reporting.html import figure
from simpel_cli.runs.files import read_columns

AT_REST = -20.0  # nats: a fit so far below the simpler model has not converged, and its spread has no meaning
NEAR_RANGE = 0.95  # share of a declared range that counts as all of it
HORIZONS = {"one_step": "one step", "horizon": "{steps} rows ahead", "free_run": "whole episode"}
Section = dict[str, Any]
Table = Mapping[str, np.ndarray]


def sections_of(
    found: Mapping[str, Any], before: Mapping[str, Any], after: Mapping[str, Any] | None, directory: Path
) -> list[Section]:
    """Return every section in reading order.

    Args:
        found: `verdict.json`.
        before: the `sim:` node as declared.
        after: that of the corrected simulator; None where there is none.
        directory: of the run, with its tables.
    """
    tables = {
        p.stem: read_columns(p) for p in directory.glob("*.parquet") if p.stem in ("errors", "parameters", "coverage")
    }
    pictures = {p.stem: figure(p) for p in draw_discover(directory)}
    own, following = pictures.pop("parameters", {}), pictures.pop("next_experiment", {})
    parts = [
        error_section(found, tables.get("errors", {})),
        equation_section(found, before, after),
        effect_section(found),
        step_section(found),
        *pictures.values(),
        prior_section(found),
        group_section(found),
        parameter_section(found, tables.get("parameters", {})) | {k: own[k] for k in ("image", "width") if k in own},
        remainder_section(found),
        not_found_section(found),
        coverage_section(tables.get("coverage", {})),
        check_section(found),
        next_section(found) | {k: following[k] for k in ("image", "width") if k in following},
        determining_section(found),
    ]
    return [part for part in parts if part]


def words(name: str) -> str:
    """Name of an effect in words."""
    return name.replace("_", " ")


def rows_of(table: Table) -> list[dict[str, Any]]:
    """Return the rows of a table."""
    return [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]


def error_section(found: Mapping[str, Any], errors: Table) -> Section:
    """Errors on test episodes, before and after."""
    error = found["error"]
    both = "after" in models_of(found)
    rows = []
    for row in rows_of(errors):
        label = HORIZONS[row["horizon"]].format(steps=error["horizon_steps"])
        cells = [label, with_unit(row["output"], row["unit"]), *_cells(row, "before")]
        if both:
            cells += [*_cells(row, "after"), *_cells(row, "reduction", "x")]
        rows.append([*cells, with_interval(row["noise_floor"])])
    likelihood = [
        with_interval(error[model]["log_likelihood_per_step"])
        for model in (("before", "after") if both else ("before",))
    ]
    rows.append(["log likelihood per row", "nat", *likelihood, *([""] if both else []), ""])
    head = ["", "", *(["before", "after", "reduction"] if both else ["calibrated"]), "noise floor"]
    n, split = (
        error["episodes"],
        " (before), and of the same with what was found (after): the reduction is due to that alone",
    )
    note = (
        f"Root mean square errors on {n} test episode{'s' if n != 1 else ''}, in the units of the data, of the simulator, "
        f"fitted to the training episodes{split if both else ''}. Whole episode: the simulator gets the inputs only. "
        f"Intervals: 95 % bootstrap over {'episodes' if n >= LEAST_EPISODES else 'blocks, where an error forgets'}."
    )
    title = "Test error before and after" if both else "Test error of the calibrated simulator"
    return {"title": title, "head": head, "rows": rows, "note": note}


def _cells(row: Mapping[str, Any], name: str, sign: str = "") -> list[str]:
    return [with_interval(row[name], row[f"{name}_low"], row[f"{name}_high"], sign)]


def equation_section(found: Mapping[str, Any], before: Mapping[str, Any], after: Mapping[str, Any] | None) -> Section:
    """Right-hand sides before and after, with what is new marked."""
    old, new = _rates(before), _rates(after) if after is not None else {}
    for state in new:
        old.setdefault(state, _as_in(before))
    if not (old or _timing(after or {})):
        return {}
    timing = _timing(before)
    lines = [[(text, False)] for text in [*(f"d({s})/dt = {e}" for s, e in old.items()), *timing]]
    both = "after" in models_of(found)
    blocks = [{"title": "before" if both else "as declared", "lines": lines}]
    text = ""
    if after is not None and both:
        lines = [[(f"d({s})/dt = ", False), *marked(str(old.get(s, "")), str(e))] for s, e in new.items()]
        lines += [[(line, line not in timing)] for line in _timing(after)]
        blocks.append({"title": f"after ({after['name']})", "lines": lines})
        lacks = found.get("corrected_sim_lacks")
        if lacks:
            text = (
                f"Not in the corrected YAML: {'; '.join(words(name) for name in lacks)}. The errors above include it."
            )
    title = "The equation before and after" if both else "The equation"
    return {"title": title, "equations": blocks, "after": text}


def _rates(sim: Mapping[str, Any]) -> dict[str, str]:
    """Return the right-hand sides that a `sim:` node declares; of equations in Python what was added to them."""
    rates = {s: str(e) for s, e in (sim.get("dynamics") or {}).items()}
    if not isinstance(base := sim.get("base"), Mapping):
        return rates
    own = _rates(base)
    return own | {s: f"{own.get(s, _as_in(base))} + {e}" for s, e in rates.items()}


def _as_in(sim: Mapping[str, Any]) -> str:
    return f"[as in {sim.get('name')}]"


def _timing(sim: Mapping[str, Any]) -> list[str]:
    """Describe parameters that differ, inputs that act differently from their recorded values, and what sensors show."""
    lines = _timing(base) if isinstance(base := sim.get("base"), Mapping) else []
    for name, node in (sim.get("parameters") or {}).items():
        if isinstance(node, Mapping) and "per" in node:
            lines.append(f"{name} has a value for every {node['per']}")
    for name, node in (sim.get("inputs") or {}).items():
        if "value" in node:
            lines.append(f"{name} acts as {node['value']}")
        if "delay" in node:
            lines.append(f"{name} acts as {name}(t - {node['delay']})")
        if "lag" in node:
            lines.append(f"{name} acts through a first-order lag with time constant {node['lag']}")
    return lines + of_sensors(sim)


def marked(old: str, new: str) -> list[tuple[str, bool]]:
    """Split a new expression into pieces, each with whether it was not in the old one."""
    a, b = (re.findall(r"\w+|\s+|\*\*|.", text) for text in (old, new))
    pieces: list[tuple[str, bool]] = []
    for kind, _, _, begin, end in difflib.SequenceMatcher(None, a, b, autojunk=False).get_opcodes():
        if end > begin:
            pieces.append(("".join(b[begin:end]), kind != "equal"))
    return pieces


def step_section(found: Mapping[str, Any]) -> Section:
    """Errors after each accepted effect, where there is more than one."""
    steps = found.get("steps") or []
    if len(steps) < 3:
        return {}
    horizon = found["error"]["horizon_steps"]
    names = list(steps[0]["error"]["horizon"])
    rows = [
        [" and ".join(words(label) for label in step["added"]) or "the calibrated simulator"]
        + [_number(step["error"][kind].get(name)) for name in names for kind in ("horizon", "free_run")]
        for step in steps
    ]
    head = [f"{name}, {kind}" for name in names for kind in (f"{horizon} rows ahead", "whole episode")]
    return {
        "title": "Step by step",
        "head": ["added", *head],
        "rows": rows,
        "note": "Test RMSE after each effect was added, with all parameters fitted again.",
    }


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def effect_section(found: Mapping[str, Any]) -> Section:
    """What was added, with sizes and evidence."""
    rows = []
    for effect in found["effects"]:
        values = "; ".join(
            f"{name} = {with_interval(p['value'], p['low'], p['high'])} {p['unit'] if p['unit'] != '1' else ''}".rstrip()
            for name, p in effect["parameters"].items()
        )
        gate = effect.get("held_out_gain")
        others = [f"{words(m['name'])} on {m['acts_on']}" for m in effect["class_members"][1:]]
        rows.append(
            [f"{words(effect['name'])} on {effect['acts_on']}: {effect.get('meaning') or ''}".rstrip(": "), values,
             f"{effect['log_evidence_gain']:.1f} nat",
             "-" if gate is None else f"{with_interval(gate['gain'], gate['low'], gate['high'])} nat",
             ", ".join(others) or "none"]
        )  # fmt: skip
    if not rows:
        return {}
    return {
        "title": "Effects that were added",
        "head": ["effect", "size (90 %)", "evidence", "held-out gain (95 %)", "equally good alternatives"],
        "rows": rows,
        "text": True,
        "note": "Evidence: loss in log evidence without the effect, with all other parameters fitted again. "
        f"One effect must gain {ACCEPT:g} nat; every further effect raises this by {FURTHER:g} nat for each of them. "
        "Held-out gain: gain in log likelihood on training episodes that the parameters were not fitted to.",
    }


def parameter_section(found: Mapping[str, Any], parameters: Table) -> Section:
    """Parameters before and after; where no effect was found, calibrated."""
    rows = []
    models = models_of(found)
    table = [row for row in rows_of(parameters) if row["model"] in models]
    for key in dict.fromkeys((r["parameter"], r["effect"]) for r in table):
        own = {r["model"]: r for r in table if (r["parameter"], r["effect"]) == key}
        first = next(iter(own.values()))
        name = with_unit(key[0], first["unit"]) + (f", {words(key[1])}" if key[1] else "")
        values = [with_interval(own[m]["value"], own[m]["low"], own[m]["high"]) if m in own else "-" for m in models]
        rows.append([name, *values, f"{first['range_low']:.3g}..{first['range_high']:.3g}"])
    if not rows:
        return {}
    return {
        "title": "Parameters before and after" if len(models) > 1 else "Calibrated parameters",
        "head": ["", *(models if len(models) > 1 else ("calibrated",)), "declared range"],
        "rows": rows,
        "note": "With 90 % intervals. A parameter whose interval fills its range is not determined by these data"
        + ("; one that changes a lot compensated for the missing effect." if found["effects"] else "."),
    }


def group_section(found: Mapping[str, Any]) -> Section:
    """Values of the parameters that differ from group to group."""
    rows = []
    for entry in found.get("groups") or []:
        name = with_unit(entry["parameter"], entry["unit"]) + (f", {words(entry['effect'])}" if entry["effect"] else "")
        gain = f"{entry['log_evidence_gain']:.1f} nat"
        rows.append([name, f"all ({entry['per']})", _interval(entry["common"]), gain])
        rows.append([name, f"spread, of its {entry['spread']['of']}", _interval(entry["spread"]), ""])
        rows += [[name, group, _interval(value), ""] for group, value in entry["values"].items()]
    if not rows:
        return {}
    return {
        "title": "Values per group",
        "head": ["", "group", "value (90 %)", "evidence"],
        "rows": rows,
        "note": "Values about a common one, with a spread (one standard deviation) that the data told: a group with few rows "
        "keeps near the common value. Evidence: loss in log evidence with one value for all groups.",
    }


def _interval(value: Mapping[str, float]) -> str:
    return with_interval(value["value"], value["low"], value["high"])


def remainder_section(found: Mapping[str, Any]) -> Section:
    """Model error that no effect explains."""
    rest = found["remainder"]
    if not rest:
        return {}
    rms = rest.get("rms", np.nan)
    size = f", with a root mean square of {rms:.3g} {rest['unit']}" if np.isfinite(rms) else ""
    where = f"The model error in d({rest['acts_on']})/dt depends on {dependence(rest)}"
    if "parameter" in rest or not rest["depends_on"]:
        where = rest["description"][0].upper() + rest["description"][1:]
    if "parameter" in rest:
        size = f" (the model error in d({rest['acts_on']})/dt has a root mean square of {rms:.3g} {rest['unit']})"
    return {
        "title": "Unexplained model error",
        "note": f"{where}{size}. No known effect "
        "explains it. The figure of the latent force shows its shape. To add an effect of your own, write one YAML file "
        "with an expression (conf/effect/).",
    }


def reliable(found: Mapping[str, Any]) -> tuple[list[Mapping[str, Any]], list[Mapping[str, Any]]]:
    """Split the effects that were not found by whether their fit converged, so that their size is known."""
    entries = found["not_found"]
    good = [e for e in entries if (e.get("log_evidence_gain") or 0.0) > AT_REST]
    return good, [e for e in entries if e not in good]


def not_found_section(found: Mapping[str, Any]) -> Section:
    """Effects that were tested and not found, with an upper bound of their size."""
    good, rest = reliable(found)
    if not good and not rest:
        return {}
    rows = [
        [f"{words(e['name'])} on {e['acts_on']}", e.get("parameter", ""),
         f"{e['smallest_detectable']:.2g} {e['unit']}".removesuffix(" 1"),
         f"{e['log_evidence_gain']:.1f} nat" if e.get("log_evidence_gain") is not None else "not fitted"]
        for e in sorted(good, key=lambda e: (e["name"], e["acts_on"]))
    ]  # fmt: skip
    after = ""
    if rest:
        names = ", ".join(f"{words(e['name'])} on {e['acts_on']}" for e in rest)
        after = f"Stopped early, because they could not reach the required evidence; their size is not known: {names}."
    return {
        "title": "Effects that were not found, and their largest possible size",
        "head": ["effect", "parameter", "smaller than", "gain in evidence"],
        "rows": rows,
        "note": "An effect of the stated size would have been accepted.",
        "after": after,
    }


def coverage_section(coverage: Table) -> Section:
    """Range of the training data against the declared ranges."""
    rows = []
    for row in rows_of(coverage):
        share = (row["high"] - row["low"]) / (row["range_high"] - row["range_low"])
        rows.append(
            [with_unit(row["quantity"], row["unit"]), f"{row['low']:.3g}..{row['high']:.3g}",
             f"{row['range_low']:.3g}..{row['range_high']:.3g}", f"{100 * min(share, 1.0):.0f} %"]
        )  # fmt: skip
    if not rows:
        return {}
    return {
        "title": "Range of the training data",
        "head": ["", "training data", "declared range", "share"],
        "rows": rows,
        "note": "The results do not apply outside the range of the training data.",
    }


def untested(coverage: Table) -> list[str]:
    """Return the ranges that the data do not cover, in words."""
    found = []
    for row in rows_of(coverage):
        share = (row["high"] - row["low"]) / (row["range_high"] - row["range_low"])
        if share < NEAR_RANGE and not row["periodic"]:
            found.append(f"{row['quantity']} outside {row['low']:.2g}..{row['high']:.2g} {row['unit']}".rstrip())
    return found


def prior_section(found: Mapping[str, Any]) -> Section:
    """SimPEL with the old and the corrected simulator as prior, on the same few transitions."""
    fits = found.get("as_prior") or {}
    rows = []
    for size, metrics in (fits.get("before") or {}).items():
        for metric, old in metrics.items():
            if new := (fits.get("after") or {}).get(size, {}).get(metric):
                name = {"nll": "NLL", "nrmse": "normalised RMSE"}.get(
                    metric, metric.replace("free_run_rmse@", "RMSE after ")
                )
                rows.append([f"{size} transitions", name, with_interval(*old), with_interval(*new)])
    note = "SimPEL fitted to the same few transitions with either prior. Errors on test episodes: median (range) over seeds."
    head = ("", "", "declared simulator", "corrected simulator")
    return {"title": "Both simulators as prior for SimPEL", "head": head, "rows": rows, "note": note} if rows else {}


def check_section(found: Mapping[str, Any]) -> Section:
    """Checks of the data, done before the search."""
    rows = [(c["check"], "ok" if c["ok"] else "warning", c["detail"]) for c in found["data_checks"]]
    return {"title": "Data checks", "head": ("check", "", "what was found"), "rows": rows, "text": True} if rows else {}


def next_section(found: Mapping[str, Any]) -> Section:
    """The experiment that would distinguish the possible causes."""
    plan = found["next_experiment"]
    if not plan:
        return {}
    rows = [
        [words(p["true"]), words(p["against"]), f"{p['expected_log_likelihood_ratio']:.1f} nat"] for p in plan["pairs"]
    ]
    head = ["if this is the cause", "compared with", "expected gain"]
    after = (
        f"{plan['file']} contains time, inputs and the prediction of each cause. Expected gain: expected change of the log "
        "evidence when the episode is added to these data; the uncertainty of the parameters of both causes is included."
        if plan["file"]
        else ""
    )
    return {"title": "Next experiment", "note": plan["description"], "head": head, "rows": rows, "after": after}


def determining_section(found: Mapping[str, Any]) -> Section:
    """Experiments that determine what the data leave open of the simulator's parameters."""
    plans = found.get("determining_experiments") or []
    rows = [(plan["combination"], plan["description"], plan["file"] or "") for plan in plans]
    head = ("left open by these data", "what to do", "file")
    return (
        {"title": "Experiments that determine what is left open", "head": head, "rows": rows, "text": True}
        if rows
        else {}
    )
