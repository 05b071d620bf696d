"""`simpel report`: runs and sweeps compared in one file that can be sent around, with LaTeX and CSV tables beside it.

It reads Parquet files and manifests only: no data set, no simulator, no checkpoint. A copy of the Parquet files will do.
"""

import contextlib
from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.errors import ConfigError, SimpelError, did_you_mean
from simpel_cli.reporting.comparison import Comparison, Run
from simpel_cli.reporting.figures.canvas import distinct
from simpel_cli.reporting.html import write_report
from simpel_cli.reporting.table_files import write_csv, write_latex
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, typed
from simpel_cli.runs.finding import Found, runs_below
from simpel_cli.runs.manifest import read_manifest
from simpel_cli.runs.metrics import read_metrics

NAMED = 20  # runs without results that are listed


def report(roots: Sequence[Path], out: Path, baseline: str | None = None, quiet: bool = False) -> Path:
    """Compare the runs below directories.

    Args:
        roots: runs, sweeps, or folders of them.
        out: folder of `report.html`, figures, `tables/*.csv` and `tables/*.tex`.
        baseline: method that the others are compared with; None: the best.
        quiet: print nothing.

    Raises:
        ConfigError: no finished run, or no such baseline.
    """
    terminal = Terminal(quiet)
    found = [each for root in roots for each in _below(root)]
    runs, unread = _read(found)
    names = distinct(run.variant for run in runs)
    if baseline is not None and baseline not in names:
        raise ConfigError(
            f"--baseline: got {baseline}; no run has this method.{did_you_mean(baseline, names)} (there are {', '.join(names)})"
        )
    if (out / "manifest.json").exists():
        raise ConfigError(f"--out: {out} is the directory of a run, which has a report of its own. Name another one.")
    make_directory(out, "--out")
    make_directory(out / "tables", "--out")
    sections: list[dict[str, Any]] = []
    leads = []
    for panel in distinct(run.panel for run in runs):
        compared = Comparison([run for run in runs if run.panel == panel], out, baseline)
        sections += compared.sections()
        leads += compared.leads()
    sections += [_cost(runs, out), *_left(found, unread)]
    seeds = {row["seed"] for run in runs for row in run.rows}
    lead = (
        f"{len(runs)} finished runs of {len(names)} {'method' if len(names) == 1 else 'methods'}, {len(seeds)} "
        f"{'seed' if len(seeds) == 1 else 'seeds'}. Means are over seeds, with 95 % intervals (Student's t) in brackets; "
        "differences are computed seed by seed."
    )
    path = write_report(
        out / "report.html",
        title=f"Report · {' · '.join(distinct(panel[1] or panel[2] for panel in (r.panel for r in runs))[:4])}",
        lead=lead,
        opening=" ".join(leads),
        sections=sections,
        commands=[
            f"simpel report {' '.join(typed(root) for root in roots)}{f' --baseline {typed(baseline)}' if baseline else ''}"
        ],
    )
    for line in leads:
        terminal.line(line)
    terminal.line(str(path), "report")
    terminal.line(f"{out / 'tables'}: {len(list((out / 'tables').iterdir()))} files, LaTeX and CSV", "tables")
    return path


def default_folder(roots: Sequence[Path]) -> Path:
    """Return the folder of the report: that of a single sweep, else a new one (a run has its own report already)."""
    if len(roots) == 1 and any((roots[0] / mark).exists() for mark in ("sweep.json", "sweep.parquet")):
        return roots[0]
    return Path("runs") / "report" / f"{datetime.now():%Y%m%d-%H%M%S}"


def _below(root: Path) -> list[Found]:
    if not root.is_dir():
        raise ConfigError(f"report: {root} is no directory. Give runs, sweeps, or folders that hold them.")
    found = list(runs_below(root))
    if not found and (root / "sweep.parquet").is_file():  # all that was copied of a sweep
        found = [Found(root, (), "done")]
    if not found:
        raise ConfigError(f"report: {root} holds no runs. Sweeps lie under runs/sweep, fits under runs/fit.")
    return found


def _read(found: Sequence[Found]) -> tuple[list[Run], list[Found]]:
    """Return the runs that are done, and those whose metrics cannot be read."""
    runs, unread = [], []
    for each in found:
        if each.status == "done":
            try:
                runs += _of(each)
            except SimpelError:
                unread.append(each)
    if not runs:
        states = Counter(each.status or "not started" for each in found)
        counted = ", ".join(f"{count} {state}" for state, count in states.items())
        raise ConfigError(f"report: none of the {len(found)} runs is complete with readable metrics ({counted}).")
    panels = distinct(run.panel for run in runs)
    return [run for panel in panels for run in _apart([run for run in runs if run.panel == panel])], unread


def _apart(runs: Sequence[Run]) -> list[Run]:
    """Return runs that are compared with each other, with only those overrides that distinguish them."""
    shared = set.intersection(*(set(run.words) for run in runs))
    return [run._replace(words=tuple(word for word in run.words if word not in shared)) for run in runs]


def _of(found: Found) -> list[Run]:
    path = found.directory / "metrics.parquet"
    if path.is_file():
        rows = read_metrics(path)
        facts: dict[str, Any] = {}
        with contextlib.suppress(SimpelError):
            facts = read_manifest(found.directory)
        return [Run(found, rows, found.words, facts)] if rows else []
    rows = read_metrics(found.directory / "sweep.parquet")
    return [
        Run(found, [r for r in rows if r["run"] == name], tuple(name.split()), {})
        for name in distinct(r["run"] for r in rows)
    ]


def _cost(runs: Sequence[Run], out: Path) -> dict[str, Any]:
    rows, full = [], []
    for name in distinct((run.panel, run.variant) for run in runs):
        own = [run for run in runs if (run.panel, run.variant) == name]
        wall = [float(run.facts["wall_seconds"]) for run in own if run.facts.get("wall_seconds")]
        train = [float(run.facts["train_seconds"]) for run in own if run.facts.get("train_seconds")]
        label = f"{name[0][1] or name[0][2]}: {name[1]}"
        full.append((label, len(own), *(_median(v) for v in (wall, train)), sum(wall)))
        rows.append(
            (
                label,
                str(len(own)),
                *(f"{_median(v):.3g}" if v else "-" for v in (wall, train)),
                f"{sum(wall) / 3600:.3g}",
            )
        )
    head = ("", "runs", "s per run, median", "s of training, median", "hours in total")
    write_latex(out / "tables" / "cost.tex", "Cost", head, rows)
    write_csv(out / "tables" / "cost.csv", ("variant", "runs", "wall_seconds", "train_seconds", "total_seconds"), full)
    note = "Wall-clock times from the manifests; runs in parallel are added up."
    return {"title": "Cost", "note": note, "head": head, "rows": rows}


def _left(found: Sequence[Found], unread: Sequence[Found]) -> list[dict[str, Any]]:
    """Return the runs that are not in the comparison."""
    left = [each for each in found if each.status != "done"]
    rows = [(str(each.directory), each.status or "not started", " ".join(each.words)) for each in left]
    rows += [(str(each.directory), "done, metrics not readable", " ".join(each.words)) for each in unread]
    if not rows:
        return []
    after = f"and {len(rows) - NAMED} more" if len(rows) > NAMED else ""
    head = ("directory", "status", "overrides")
    return [{"title": "Runs without results", "head": head, "rows": rows[:NAMED], "text": True, "after": after}]


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")
