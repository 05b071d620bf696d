"""SimPEL with the declared and with the corrected simulator as prior, fitted to the same few transitions."""

from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from simpel_cli.data import transitions
from simpel_cli.data.recording import Source
from simpel_cli.inference import loop
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.metrics import write_metrics
from simpel_cli.studies.declared import Declared
from simpel_cli.studies.judgement import judge
from simpel_cli.studies.open import open_study
from simpel_cli.studies.prepare import STRETCH, posteriors, prepare
from simulators.model import Model

SIZES = (20, 50)  # training transitions
SEEDS = 5
SHOWN = ("nll", "nrmse")  # joint, beside the errors ahead

Summary = dict[str, dict[str, dict[str, list[float]]]]


def past_inputs(source: Source) -> int:
    """Return the number of past inputs that a transition of a simulator needs."""
    return source.past() + source.echoes() if isinstance(source, Model) else 0


def close(declared: Declared, corrected: Declared, directory: Path, data_folder: Path, terminal: Terminal) -> Summary:
    """Fit SimPEL with both simulators and test both on the test episodes; writes `metrics.parquet`.

    Both get the same transitions, past inputs, method and seeds.

    Args:
        declared: configuration of the search.
        corrected: the same with the corrected simulator.
        directory: of the run; each fit's tables go below `close/`.
        data_folder: folder of the data YAML.
        terminal: for a line per fit.

    Returns:
        before|after -> training transitions -> metric -> [median, smallest, largest] over seeds.
    """
    both = {"before": declared, "after": corrected}
    stack = max(declared.measurements.stack_actions, *(past_inputs(one.source) for one in both.values()))
    own_run = {**(declared.config.get("run") or {}), "precision": "float32", "seeds": SEEDS, "quiet": True}
    rows: list[dict[str, Any]] = []
    found: Summary = {"before": {}, "after": {}}
    for n in SIZES:
        began = perf_counter()
        data = declared.config["data"] | {"n_train": n, "stack_actions": stack}
        studies = {k: open_study(one.changed(run=own_run, data=data), data_folder) for k, one in both.items()}
        if len(transitions(studies["before"].recording.train, stack).row) < n:
            break
        for label, study in studies.items():
            fitted = prepare(study)
            program = loop.compiled(fitted.bind, fitted.assembled.problems, fitted.keys, STRETCH)
            *_, last = loop.train(program, study.method.steps)
            folder = directory / "close" / f"{label}_{n}"
            folder.mkdir(parents=True)
            spread = np.asarray(fitted.normaliser.y_std)
            judged = judge(study, posteriors(study, fitted, last.state), spread, folder, study.method.steps)
            same = study.constants | {"run": directory.name, "command": "discover", "n_train": n}
            rows += [same | row for row in judged.rows]
            found[label][str(n)] = _summary(judged.rows)
        compared = _compared(*(found[label][str(n)] for label in both))
        terminal.line(f"{n} transitions, {SEEDS} seeds: {compared} ({perf_counter() - began:.0f} s)", "prior")
    write_metrics(directory / "metrics.parquet", rows, {})
    return found


def _summary(rows: list[dict[str, Any]]) -> dict[str, list[float]]:
    """Median, smallest and largest seed of what is shown."""
    values: dict[str, list[float]] = {}
    for row in rows:
        metric, output = row["metric"], row.get("output", "")
        if metric in SHOWN and output == "joint":
            values.setdefault(metric, []).append(row["value"])
        elif (
            metric.startswith("free_run_rmse@") and not metric.endswith(("_low", "_high")) and np.isfinite(row["value"])
        ):
            values.setdefault(f"{metric} {output}", []).append(row["value"])
    return {k: [float(np.median(v)), float(np.min(v)), float(np.max(v))] for k, v in values.items()}


def _compared(old: dict[str, list[float]], new: dict[str, list[float]]) -> str:
    """Return before and after in one line: NLL, and the error at the longest horizon."""
    longest = [k for k in old if k.startswith("free_run_rmse@")]
    last = max((float(k.split("@")[1].split("s ")[0]) for k in longest), default=0.0)
    shown = ["nll", *(k for k in longest if float(k.split("@")[1].split("s ")[0]) == last)]
    names = {"nll": "test NLL"} | {k: k.replace("free_run_rmse@", "RMSE after ") for k in longest}
    return ", ".join(f"{names[k]} {_spread(old[k])} -> {_spread(new[k])}" for k in shown if k in new)


def _spread(values: list[float]) -> str:
    median, low, high = values
    return f"{median:.3g} ({low:.3g}..{high:.3g})"
