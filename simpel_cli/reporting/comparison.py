"""Comparison of the runs of one verb, experiment and data set: tables, figures, a sentence."""

import contextlib
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli.evaluation.comparison import METRICS, Mean, Metric, best, by_seed, difference, points, variant
from simpel_cli.reporting.figures.canvas import distinct, with_interval
from simpel_cli.reporting.figures.compare import Course, draw_calibrations, draw_courses
from simpel_cli.reporting.figures.sweep import draw_by_size
from simpel_cli.reporting.html import figure
from simpel_cli.reporting.table_files import write_csv, write_latex
from simpel_cli.runs.files import read_columns
from simpel_cli.runs.finding import Found

COURSES = {  # verb -> metric, its split, what it runs along, what it is called
    "fit": ("loss", "train", "step", "training loss: NLL per point [nat]"),
    "rl-offline": ("return_in_model", "train", "step", "return in the model"),
    "rl-online": ("return", "test", "episode", "return"),
}


class Run(NamedTuple):
    """A finished run.

    Args:
        found: where it is.
        rows: of its metrics.
        words: its overrides, less those that all runs of its panel share.
        facts: of its manifest; empty where there is none.
    """

    found: Found
    rows: list[dict[str, Any]]
    words: tuple[str, ...]
    facts: dict[str, Any]

    @property
    def panel(self) -> tuple[str, str, str]:
        """What it may be compared within."""
        row = self.rows[0]
        return row["command"], row["experiment"] or "", row["data"] or ""

    @property
    def variant(self) -> str:
        """Name of its method."""
        return variant(self.rows[0], self.words)


class Comparison:
    """The runs of one verb, experiment and data set.

    Args:
        runs: at least one.
        out: folder of figures and of `tables/`.
        baseline: method that the others are compared with; None: the best.
    """

    def __init__(self, runs: Sequence[Run], out: Path, baseline: str | None) -> None:
        self.panel = panel = runs[0].panel
        self.runs, self.out, self.baseline = runs, out, baseline
        self.every = [point for run in runs for point in points(run.rows, run.words)]
        self.name = panel[1] or panel[2] or panel[0]
        self.slug = "-".join(filter(None, (panel[0], panel[1] or panel[2])))
        there = {p.metric for p in self.every}
        self.metrics = [m for m in METRICS.get(panel[0], ()) if m.name in there]
        self.cells = {m.name: by_seed(self.every, m.name) for m in self.metrics}

    def sections(self) -> list[dict[str, Any]]:
        """Return everything there is to say."""
        found: list[dict[str, Any]] = []
        chosen = next((m for m in self.metrics if m.sign), None)
        if chosen is not None:
            found.append(self._best(chosen))
        drawn = draw_by_size(self.every, self.out / f"{self.slug}.png") if len(self._sizes()) > 1 else None
        if drawn is not None:
            note = "Test metrics. Lines: medians over seeds; bands: smallest to largest seed."
            found.append(
                figure(drawn) | {"title": f"{self.name}: metrics by number of training transitions", "note": note}
            )
        found += [self._means(metric) for metric in self.metrics]
        if chosen is not None:
            found += self._differences(chosen)
        return found + self._courses() + self._calibration() + self._verdicts()

    def leads(self) -> list[str]:
        """Return the main result in one sentence."""
        chosen = next((m for m in self.metrics if m.sign), None)
        if chosen is None or len({name for name, _ in self.cells[chosen.name]}) < 2:
            return []
        last = best(self.cells[chosen.name], chosen)[-1]
        size = f" at n = {last.size}" if last.size else ""
        if not last.second:
            return []
        sure = f"ahead of {last.second} by {_shown(last.lead)}"
        if not last.lead.certain:
            sure = f"but the gain over {last.second} is not certain (difference {_shown(last.lead)})"
        return [f"{self.name}: {last.variant} has the best {chosen.label}{size}, {sure}."]

    def _sizes(self) -> list[int]:
        return sorted({p.size for p in self.every})

    def _best(self, metric: Metric) -> dict[str, Any]:
        rows = [
            (_size(b.size), b.variant, _shown(b.score), b.second or "-", _shown(b.lead), _certain(b.lead))
            for b in best(self.cells[metric.name], metric)
        ]
        head = ("transitions", "best", metric.label, "second", "lead", "")
        write_latex(self.out / "tables" / f"{self.slug}-best.tex", f"{self.name}: best configurations", head, rows)
        note = (
            "Lead: mean difference to the second, compared seed by seed; positive where the best is better. The best was "
            "chosen on the same seeds, so its lead is slightly optimistic."
        )
        return {"title": f"{self.name}: best configuration", "note": note, "head": head, "rows": rows}

    def _means(self, metric: Metric) -> dict[str, Any]:
        cells, sizes = self.cells[metric.name], self._sizes()
        names = distinct(name for name, _ in cells)
        means = {cell: metric.over(values.values()) for cell, values in cells.items()}
        rows = [(name, *(_shown(means.get((name, n))) for n in sizes)) for name in names]
        head = ("", *map(_size, sizes))
        stem = self.out / "tables" / f"{self.slug}-{metric.name}"
        write_latex(stem.with_suffix(".tex"), f"{self.name}: {metric.label}", head, rows)
        write_csv(
            stem.with_suffix(".csv"),
            ("variant", "n_train", "mean", "low", "high", "seeds"),
            [(name, n, m.value, m.low, m.high, m.seeds) for (name, n), m in means.items()],
        )
        counts = sorted({m.seeds for m in means.values()})
        how = f"{counts[0]} seeds" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds"
        return {"title": f"{self.name}: {metric.label}", "note": f"Mean over {how}.", "head": head, "rows": rows}

    def _differences(self, metric: Metric) -> list[dict[str, Any]]:
        cells, sizes = self.cells[metric.name], self._sizes()
        names = distinct(name for name, _ in cells)
        if len(names) < 2:
            return []
        base = best(cells, metric)[-1].variant if self.baseline not in names else str(self.baseline)
        found = {
            (name, n): difference(cells[name, n], cells[base, n])
            for name in names
            for n in sizes
            if name != base and (name, n) in cells and (base, n) in cells
        }
        rows = [(name, *(_shown(found.get((name, n))) for n in sizes)) for name in names if name != base]
        head = (f"minus {base}", *map(_size, sizes))
        stem = self.out / "tables" / f"{self.slug}-{metric.name}-differences"
        write_latex(stem.with_suffix(".tex"), f"{self.name}: {metric.label}, difference to {base}", head, rows)
        write_csv(
            stem.with_suffix(".csv"),
            ("variant", "baseline", "n_train", "difference", "low", "high", "pairs"),
            [(name, base, n, m.value, m.low, m.high, m.seeds) for (name, n), m in found.items()],
        )
        better = "above" if metric.sign > 0 else "below"
        note = f"Compared seed by seed; {better} zero: better than {base}. If the interval contains 0, the gain is not certain."
        title = f"{self.name}: {metric.label}, difference to {base}"
        return [{"title": title, "note": note, "head": head, "rows": rows}]

    def _courses(self) -> list[dict[str, Any]]:
        if self.panel[0] not in COURSES:
            return []
        metric, split, across, label = COURSES[self.panel[0]]
        courses = []
        for run in self.runs:
            own = [r for r in run.rows if r["metric"] == metric and r["split"] == split and r["value"] is not None]
            for line in distinct((r["seed"], r["output"]) for r in own):
                along = [(r["step"], r["value"]) for r in own if (r["seed"], r["output"]) == line]
                steps, values = (np.array(column, dtype=float) for column in zip(*along, strict=True))
                courses.append(Course(run.variant, run.rows[0]["n_train"] or 0, steps, values))
        courses = [course for course in courses if len(course.steps) > 1]
        if not courses:
            return []
        path = draw_courses(courses, label, across, self.out / f"{self.slug}-learning.png")
        return [figure(path) | {"title": f"{self.name}: learning curves", "note": "One line per run and seed."}]

    def _calibration(self) -> list[dict[str, Any]]:
        size = max(self._sizes(), default=0)
        gathered: dict[str, list[dict[str, np.ndarray]]] = {}
        for run in self.runs:
            path = run.found.directory / "calibration.parquet"
            if (run.rows[0]["n_train"] or 0) == size and path.is_file():
                with contextlib.suppress(Exception):  # a damaged file is left out
                    table = read_columns(path)
                    joint = table["output"] == "joint"
                    gathered.setdefault(run.variant, []).append({c: table[c][joint] for c in ("level", "fraction")})
        if not gathered:
            return []
        columns = {
            name: {c: np.concatenate([t[c] for t in tables]) for c in ("level", "fraction")}
            for name, tables in gathered.items()
        }
        path = draw_calibrations(columns, self.out / f"{self.slug}-calibration.png")
        note = f"Test data, all outputs{f', n = {size}' if size else ''}. Lines: means; bands: smallest to largest run."
        return [figure(path) | {"title": f"{self.name}: calibration", "note": note}]

    def _verdicts(self) -> list[dict[str, Any]]:
        counts: Counter[tuple[str, str, str]] = Counter()
        for run in self.runs:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                found = json.loads((run.found.directory / "verdict.json").read_text())
                effects = ", ".join(str(e.get("name", "")) for e in found.get("effects") or [])
                counts[run.variant, str(found.get("verdict")), effects or "-"] += 1
        if not counts:
            return []
        rows = [(*key, str(count)) for key, count in sorted(counts.items(), key=lambda item: (item[0][0], -item[1]))]
        return [{"title": f"{self.name}: verdicts", "head": ("", "verdict", "effects", "runs"), "rows": rows}]


def _shown(found: Mean | None) -> str:
    return "-" if found is None else with_interval(found.value, found.low, found.high)


def _certain(found: Mean) -> str:
    if found.seeds < 2:
        return "one seed" if found.seeds else ""
    return "the gain is certain" if found.certain else "the gain is not certain"


def _size(size: int) -> str:
    return f"n = {size}" if size else "all"
