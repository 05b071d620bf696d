"""The terminal's screen and the report of `fit` and `evaluate`."""

from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.config.resolved import dump
from simpel_cli.data import Recording
from simpel_cli.data.summary import held_out_summary, split_summary
from simpel_cli.evaluation import IN_DATA_UNITS, MIXED, joint_unit
from simpel_cli.inference.prior_predictive import PriorCheck
from simpel_cli.inference.protocols import Method
from simpel_cli.reporting.figures import draw_run
from simpel_cli.reporting.html import figure, write_report
from simpel_cli.reporting.prior_check import describe_prior
from simpel_cli.reporting.run_table import law_of_noise, lengthscales, named_method, run_table
from simpel_cli.runs.console import Terminal, aligned
from simpel_cli.runs.directory import typed
from simpel_cli.runs.manifest import Manifest
from simpel_cli.studies.judgement import Judged
from simpel_cli.studies.open import Study
from simpel_cli.studies.prepare import Fitted
from simpel_cli.studies.screen import Screen

METRICS = {
    "nll": "NLL",
    "rmse": "RMSE",
    "nrmse": "normalised RMSE",
    "mae": "MAE",
    "crps": "CRPS",
    "coverage_90": "coverage of 90 %",
    "calibration_error": "calibration error",
}

NOTE = (
    "Normalised RMSE: RMSE divided by the standard deviation of the simulator's own output over its declared ranges; joint: "
    "root mean square over outputs. Joint errors in data units are shown where all outputs share a unit."
)


def describe(terminal: Terminal, study: Study, fitted: Fitted, checked: PriorCheck | None) -> None:
    """Print data, simulator and prior in a few lines."""
    s, recording, source = study.settings, study.recording, study.system.source
    seeds = f"seed {s.seed}" if s.seeds == 1 else f"seeds {s.seed}..{s.seed + s.seeds - 1}"
    terminal.line(
        f"simpel fit · {s.name} · {named_method(study)} · {seeds} · {study.device.platform} {s.precision}",
        style="bold",
    )
    rows = len(fitted.training[0].x)
    describe_data(terminal, recording, f"{split_summary(recording)}, {used(study.method, source, rows)}")
    uncertain = " ".join(q.name for q in source.params) or "nothing"
    kind = "" if study.system.transition is not None else " (black box)"
    terminal.line(f"{source.name}{kind}   uncertain parameters: {uncertain}   {_gap_text(study, fitted)}", "simulator")
    terminal.line(law_of_noise(study, fitted), "noise")
    if checked is not None:
        describe_prior(terminal, checked)


def describe_data(terminal: Terminal, recording: Recording, used: str) -> None:
    """Print which file was read, what of it is used, and the warnings of the checks."""
    failed = [c for c in recording.checks if not c.ok]
    if not recording.files:
        terminal.line("no measurements: the posterior is the prior", "data")
        return
    more = sum(file.suffix != ".yaml" for file in recording.files[1:])  # cards only describe
    terminal.line(
        f"{recording.files[0]}{f' and {more} more' if more else ''}   {used}   checks {len(recording.checks) - len(failed)} ok"
        + (f", {len(failed)} with warnings" if failed else ""),
        "data",
    )
    for check in failed:
        terminal.line(f"{check.name}: {check.detail}", "", style="yellow")
    if recording.estimated:
        terminal.line(f"not measured, estimated from the position: {', '.join(recording.estimated)}", "")


def used(method: Method, source: Any, rows: int) -> str:
    """Number of training transitions; a simulator without states has no time step."""
    most = getattr(method, "most_rows", rows)
    beyond = f" (the method takes {most} of them, evenly spaced: method.most_rows)" if rows > most else ""
    return f"{rows} transitions used{beyond}, dt {source.dt:g} s" if source.states else f"{rows} rows used{beyond}"


def _gap_text(study: Study, fitted: Fitted) -> str:
    gap = study.prior.gap
    if gap is None or fitted.assembled.gap_scale is None:
        return "no gap GP"
    words = "".join(f" {c.lower()}" if c.isupper() else c for c in type(gap.kernel).__name__).strip()
    scale = " ".join(f"{v:.2g}" for v in fitted.assembled.gap_scale)
    what = "gap GP" if study.prior.uses_simulator else "GP prior, no simulator"
    return f"{what}: {words}, lengthscales {lengthscales(study, fitted)}, scale kappa {scale}"


def describe_evaluation(terminal: Terminal, run: Path, step: int, study: Study, judged_on: Study) -> None:
    """Print which fit is tested, and on which data."""
    terminal.line(f"simpel evaluate · {run} · step {step}", style="bold")
    rows = held_out_summary(judged_on.recording)
    what = f"the test split of the fit, {rows}" if judged_on is study else f"all of it, {rows}, not used in the fit"
    describe_data(terminal, judged_on.recording, what)


def publish(terminal: Terminal, fit: Study, fitted: Fitted, study: Study, judged: Judged, manifest: Manifest) -> None:
    """Print the test results, draw the figures, write the report, and print the paths and the next commands.

    Args:
        terminal: to print to.
        fit: what was fitted.
        fitted: its problems, as they were trained.
        study: what was tested, with the measurements.
        judged: the results.
        manifest: of the verb that runs.
    """
    directory = manifest.directory
    source = Path(manifest.facts["run"]) if manifest.command == "evaluate" else directory
    values = _by_metric(judged.rows)
    tested = held_out_summary(study.recording)
    terminal.line()
    terminal.line(f"{f'test ({tested})':<20}{_headline(study, values)}")
    table = _table(study, values)
    terminal.line(aligned(table["head"], table["rows"]))
    free = _free_run_table(study, values)
    if free is not None:
        terminal.line(aligned(free["head"], free["rows"]))
    spread = "95 % bootstrap, outermost ends over seeds" if study.settings.seeds > 1 else "95 % bootstrap"
    terminal.line(f"(intervals: {spread}, resampling {judged.blocks})", style="dim")
    next_commands = _next(study, source)
    what = "One step ahead" if study.system.encoding.states else "Predictions"
    tables = [table | {"title": f"{what}, test data", "note": NOTE}]
    if free is not None:
        tables.append(free | {"title": "Error ahead, test data"})
    checks = {
        "title": "Data checks",
        "head": ("check", "", "what was found"),
        "rows": [(c.name, "ok" if c.ok else "warning", c.detail) for c in study.recording.checks],
        "text": True,
    }
    s = study.settings
    figures = draw_run(directory) if s.figures else []
    report = write_report(
        directory / "report.html",
        title=f"simpel {manifest.command} · {s.name} · {study.choices.get('method', '')}",
        lead=f"{study.system.source.name} on {study.recording.files[0].name}, tested on {tested}, seeds {s.all_seeds}. "
        f"Intervals are {spread}, resampling {judged.blocks}.",
        sections=[*tables, run_table(fit, fitted, judged, manifest), checks, *map(figure, figures)],
        commands=next_commands,
        config=dump(fit.declared.config),
    )
    terminal.line(str(report), "report")
    terminal.next(next_commands)


NO_INTERVAL = [float("nan")]  # of what is no mean over test points
Values = dict[tuple[str, str], tuple[float, float, float]]


def _by_metric(rows: list[dict[str, Any]]) -> Values:
    """Mean over seeds, with the outermost interval ends over seeds."""
    grouped: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        grouped.setdefault((row["metric"], row["output"]), []).append(row["value"])
    plain = [key for key in grouped if not key[0].endswith(("_low", "_high"))]
    return {
        (metric, output): (
            float(np.mean(grouped[metric, output])),
            min(grouped.get((f"{metric}_low", output), NO_INTERVAL)),
            max(grouped.get((f"{metric}_high", output), NO_INTERVAL)),
        )
        for metric, output in plain
    }


def _shown(estimate: tuple[float, float, float]) -> str:
    value, low, high = estimate
    if np.isnan(value):
        return "not measured"
    if np.isnan(low):
        return f"{value:.3g}"
    return f"{value:.3g} ({low:.3g}..{high:.3g})"


def _headline(study: Study, values: Values) -> str:
    """Joint results: errors in the outputs' common unit, or normalised where they have none in common."""
    unit = joint_unit(study.system.encoding)
    errors = ("nrmse",) if unit == MIXED else ("rmse", "crps")
    shown = [f"NLL {_shown(values['nll', 'joint'])}"]
    shown += [f"{_named(METRICS[m], '' if m == 'nrmse' else unit)} {_shown(values[m, 'joint'])}" for m in errors]
    return "   ".join([*shown, f"coverage of 90 %: {100 * values['coverage_90', 'joint'][0]:.0f} %"])


def _table(study: Study, values: Values) -> dict[str, Any]:
    encoding = study.system.encoding
    kinds = set(encoding.y_kinds)
    mixed = len(kinds) > 1
    names = [
        _named(f"change of {name}" if mixed and kind == "change" else name, unit)
        for name, unit, kind in zip(encoding.y_names, encoding.y_units, encoding.y_kinds, strict=True)
    ]
    rows = [
        (shown, *(_shown(values[m, name]) for m in METRICS))
        for shown, name in zip(names, encoding.y_names, strict=True)
    ]
    unit = joint_unit(encoding)
    # a sum over outputs of different units is kept in metrics.parquet, labelled as such; shown, it would mislead
    hidden = IN_DATA_UNITS if unit == MIXED else ()
    joint = ("-" if m in hidden else _shown(values[m, "joint"]) for m in METRICS)
    rows.append((_named("joint", "" if unit == MIXED else unit), *joint))
    head = "one step" if mixed else {"change": "change in one step", "value": "value"}[kinds.pop()]
    return {"head": (head, *METRICS.values()), "rows": rows}


def _named(name: str, unit: str) -> str:
    return name if unit in ("1", "") else f"{name} [{unit}]"


def _free_run_table(study: Study, values: Values) -> dict[str, Any] | None:
    found = [m for m, _ in values if m.startswith("free_run_rmse@")]
    metrics = list(dict.fromkeys(found))
    if not metrics:
        return None
    rows = [
        (_named(q.name, q.unit), *(_shown(values[m, q.name]) for m in metrics)) for q in study.system.encoding.states
    ]
    return {"head": ("RMSE ahead", *(m.split("@")[1].replace("s", " s ahead") for m in metrics)), "rows": rows}


def _next(study: Study, fit: Path) -> list[str]:
    """Return the next commands, as they can be typed in the same directory."""
    chosen = study.choices
    own = f" --config-dir {typed(chosen['config_dir'])}" if chosen.get("config_dir") else ""
    what = (
        f"experiment={chosen['experiment']}"
        if chosen.get("experiment")
        else f"sim={chosen['sim']} data={chosen['data']}"
    )
    used = study.measurements.n_train
    sizes = f"{max(2, used // 2)},{used}" if used else "10,20"
    return [
        f"simpel evaluate {typed(fit)}          # tests again; data=NAME tests on another file",
        f"simpel sweep{own} {what} method=simpel,fsvgd data.n_train={sizes} 'run.seed=range(3)'",
    ]


SCREEN = Screen(describe, describe_evaluation, publish)
