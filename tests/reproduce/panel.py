"""Fits of a panel: every method on every training size and seed, resumable, two at a time, each on a core of its own.

A fit is what `simpel fit` does with the words of the job; its directory keeps the configuration, the manifest and the metrics.
"""

import argparse
import itertools
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

from simpel_cli.config.compose import launch
from simpel_cli.errors import SimpelError
from simpel_cli.reporting.figures.canvas import legend_below, line_style, new_figure, ratio_scale, save
from simpel_cli.runs.files import write_table, write_text
from simpel_cli.runs.manifest import read_manifest
from simpel_cli.runs.metrics import read_metrics
from simpel_cli.sweeps.verbs import STARTS as VERBS

CONF = Path(__file__).parent / "conf"
METRICS = ("nll", "nll_sum", "nrmse")
WORDS = "words.txt"  # of a fit: another fit of the same name is not this one


class Fit(NamedTuple):
    """One fit of a panel: several model seeds at once.

    Args:
        system, method: names of the panel.
        n_train: training transitions.
        data_seed: of measurements, or of what of them is trained on.
        words: overrides of the verb.
        verb: of simpel.
        conf: folder of groups that simpel does not bring.
    """

    system: str
    method: str
    n_train: int
    data_seed: int
    words: tuple[str, ...]
    verb: str = "fit"
    conf: Path = CONF

    @property
    def name(self) -> str:
        """Name of its directory."""
        return f"{self.system}-{self.method}-n{self.n_train}-s{self.data_seed}"


class Cell(NamedTuple):
    """What all fits of one method at one training size came to; rows: data seeds, columns: model seeds."""

    values: np.ndarray

    @property
    def mean(self) -> float:
        """Mean over data seeds and model seeds."""
        return float(np.nanmean(self.values))

    @property
    def spread(self) -> float:
        """Standard deviation over model seeds of the mean over data seeds, as the paper's bands have it; of one model
        seed that over data seeds."""
        values = self.values[np.isfinite(self.values).any(axis=1)]
        means = np.nanmean(values, axis=0 if values.shape[1] > 1 else 1)
        return float(np.nanstd(means, ddof=1)) if len(means) > 1 else 0.0


STEPS = {"greybox": "method.residual.steps", "sysid": None, "gp": None}  # where not method.steps; None: no network
FSVGD = ("simpel", "simpel_only_sim", "simpel_high_fidelity", "fsvgd")
WHERE = dict.fromkeys(FSVGD, "method.") | {"greybox": "method.residual."}
# more points of the box than the defaults have, and fewer draws, at about the same cost, for every prior over functions
POINTS = ("pool=1024", "sets=128")
NEWTON = ("precondition=true", "fresh_points=32")
DRAWS = dict.fromkeys(FSVGD[:3], 256) | {"pathwise": 512}
STARTS = {"sysid": "method.starts", "gp": "method.sysid.starts", "greybox": "method.sysid.starts"}
SPREAD = (
    "Test NLL, joint over outputs: mean ± standard deviation over model seeds of the mean over data seeds (of one model seed: "
    "over data seeds). Advantages are paired, with 95 % intervals over data seeds."
)
Table = dict[tuple[str, str, int], Cell]  # (system, method, n_train)


def words_of(method: str, steps: int, *, newton: bool = False, starts: int | None = None) -> list[str]:
    """Return the words that a method has beside those of the panel.

    Args:
        method: name of simpel's.
        steps: of every method that trains a network.
        newton: networks under a prior over functions go in Newton's direction.
        starts: that a simulator is identified from; None: the default.
    """
    key = STEPS.get(method, "method.steps")
    words = [f"{key}={steps}"] if key else []
    if method in WHERE:
        words += [f"{WHERE[method]}{point}" for point in (*POINTS, *(NEWTON if newton else ()))]
    if method in STARTS and starts is not None:
        words.append(f"{STARTS[method]}={starts}")
    if method in DRAWS:
        words.append(f"prior.draws={DRAWS[method]}")
    return words


def options(name: str, about: str | None, methods: Iterable[str]) -> argparse.ArgumentParser:
    """Return what a panel can be asked for."""
    parser = argparse.ArgumentParser(prog=f"tests.reproduce.{name}", description=about)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--size", choices=("small", "full"), default="small")
    parser.add_argument("--methods", nargs="+", choices=list(methods), default=list(methods))
    parser.add_argument("--data-seeds", type=int, help="small: 2, full: 5")
    parser.add_argument("--model-seeds", type=int, help="small: 1, full: 5")
    parser.add_argument("--steps", type=float, help="share of the number of steps; small: 0.3")
    parser.add_argument("--processes", type=int, default=2)
    return parser


def run(fits: Sequence[Fit], out: Path, processes: int) -> None:
    """Run what is missing, longest sizes first, and say how it goes; a fit that fails costs itself only."""
    todo = [fit for fit in fits if not _done(fit, out)]
    print(f"{len(fits)} fits, {len(fits) - len(todo)} are there, {len(todo)} to run", flush=True)
    began = time.perf_counter()
    # a worker has one core: threads of LAPACK, started before it is held to that, would take turns on it
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
    context = multiprocessing.get_context("spawn")
    cores = context.Queue()
    for core in itertools.islice(itertools.cycle(sorted(os.sched_getaffinity(0))), processes):
        cores.put(core)
    # data seeds share a compiled program: one worker takes them all, so that no two compile the same
    groups = [list(group) for _, group in itertools.groupby(todo, lambda fit: fit[:3])]
    done = 0
    with ProcessPoolExecutor(processes, mp_context=context, initializer=_pin, initargs=(cores,)) as pool:
        for future in as_completed([pool.submit(_fit_all, group, out) for group in groups]):
            for name, message in future.result():
                done += 1
                left = (time.perf_counter() - began) / done * (len(todo) - done) / 60
                print(f"{done}/{len(todo)}  {name}  {message}  about {left:.0f} min left", flush=True)


def _pin(cores: "multiprocessing.Queue[int]") -> None:
    """Keep a worker on one core, before JAX counts them, and end it with the script, however that ends."""
    os.sched_setaffinity(0, {cores.get()})
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _done(fit: Fit, out: Path) -> bool:
    """Say whether a fit of these very words is there."""
    words = out / fit.name / WORDS
    try:
        return read_manifest(out / fit.name)["status"] == "done" and words.read_text().splitlines() == [*fit.words]
    except (SimpelError, OSError):
        return False


def _fit_all(fits: Sequence[Fit], out: Path) -> list[tuple[str, str]]:
    return [(fit.name, _fit(fit, out / fit.name)) for fit in fits]


def _fit(fit: Fit, directory: Path) -> str:
    began = time.perf_counter()
    for number in itertools.count():  # what a kill left behind stays for whoever wants to look at it
        if not directory.exists():
            break
        if not (old := directory.with_name(f"{directory.name}.broken{number}")).exists():
            directory.rename(old)
    words = [*fit.words, f"hydra.run.dir={directory}", "run.figures=false", "run.quiet=true"]
    try:
        launch(fit.verb, VERBS[fit.verb], words, config_dir=fit.conf, flags=[])
    except Exception as error:  # whatever it is, it costs this fit and no other
        return f"failed: {error!r}"
    write_text(directory / WORDS, "\n".join(fit.words) + "\n")
    return f"{_came_to(tested(directory))}  {time.perf_counter() - began:.0f} s"


def _came_to(rows: list[dict[str, Any]]) -> str:
    for metric, name in (("nll", "NLL"), ("return_in_truth", "return"), ("return", "returns")):
        values = [r["value"] for r in rows if r["metric"] == metric and r["output"] in ("", "joint")]
        if values:
            return f"{name} {np.mean(values):.3g}"
    return "done"


def tested(directory: Path) -> list[dict[str, Any]]:
    """Return the test metrics of a fit."""
    return [r for r in read_metrics(directory / "metrics.parquet") if r["split"] == "test"]


def scales(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return what normalises the error of every output: the spread over the ranges of the simulator that a fit had."""
    rmse, normalised = ({r["output"]: r["value"] for r in rows if r["metric"] == m} for m in ("rmse", "nrmse"))
    return {name: rmse[name] / normalised[name] for name in normalised if name != "joint" and normalised[name] > 0}


def judged(rows: list[dict[str, Any]], scale: dict[str, float]) -> list[tuple[int, str, float]]:
    """Return (model seed, metric, value): joint NLL, the sum of the outputs' own, and the root mean square of the errors of
    all outputs over `scale`."""
    found = [(r["seed"], "nll", r["value"]) for r in rows if (r["metric"], r["output"]) == ("nll", "joint")]
    for seed in sorted({r["seed"] for r in rows}):
        alone = [r["value"] for r in rows if r["metric"] == "nll" and r["seed"] == seed and r["output"] != "joint"]
        found.append((seed, "nll_sum", float(np.sum(alone)) if alone else float("nan")))
        own = {r["output"]: r["value"] for r in rows if r["metric"] == "rmse" and r["seed"] == seed}
        found.append((seed, "nrmse", float(np.sqrt(np.mean([(own[name] / s) ** 2 for name, s in scale.items()])))))
    return found


def collect(fits: Iterable[Fit], out: Path, name: str) -> dict[str, Table]:
    """Write `name`.parquet of all fits that are done, and return metric -> table.

    Errors of a system are normalised by the simulator of its first method, whatever simulator the others have.
    """
    fits = [fit for fit in fits if _done(fit, out)]
    first = {fit.system: fit for fit in reversed(fits)}
    scale = {system: scales(tested(out / fit.name)) for system, fit in first.items()}
    rows = [(*fit[:4], *judged_row) for fit in fits for judged_row in judged(tested(out / fit.name), scale[fit.system])]
    columns = ("system", "method", "n_train", "data_seed", "model_seed", "metric", "value")
    write_table(out / f"{name}.parquet", {c: [row[i] for row in rows] for i, c in enumerate(columns)})
    found: dict[str, Table] = {}
    for metric in METRICS:
        own = [row for row in rows if row[5] == metric]
        # every cell has a place for every seed, so that cells can be compared seed by seed
        data, models = (sorted({row[i] for row in own}) for i in (3, 4))
        table: Table = {}
        for key in dict.fromkeys(row[:3] for row in own):
            values = np.full((len(data), len(models)), np.nan)
            for row in own:
                if row[:3] == key:
                    values[data.index(row[3]), models.index(row[4])] = row[6]
            table[key] = Cell(values)
        found[metric] = table
    return found


def sizes_of(table: Table, system: str) -> list[int]:
    """Return the training sizes of a system."""
    return sorted({n for s, _, n in table if s == system})


def methods_of(table: Table, system: str) -> list[str]:
    """Return the methods of a system, in the order in which they were run."""
    return list(dict.fromkeys(m for s, m, _ in table if s == system))


def advantage(table: Table, system: str, one: str, other: str, n: int) -> tuple[float, float]:
    """Return how much lower `one` is than `other`, paired, and the half width of its 95 % interval over data seeds.

    nan where one of them is missing; seeds that only one of them has do not count.
    """
    cells = [table.get((system, method, n)) for method in (one, other)]
    if cells[0] is None or cells[1] is None:
        return float("nan"), float("nan")
    gap = cells[1].values - cells[0].values
    means = np.array([row[np.isfinite(row)].mean() for row in gap if np.isfinite(row).any()])
    if len(means) < 2:
        return float(means.mean()) if len(means) else float("nan"), float("nan")
    half = scipy.stats.t.ppf(0.975, len(means) - 1) * means.std(ddof=1) / np.sqrt(len(means))
    return float(means.mean()), float(half)


def best_of(table: Table, system: str, methods: Iterable[str], n: int) -> str | None:
    """Return the method with the lowest mean at a training size; None where none of them is there."""
    there = [(table[system, m, n].mean, m) for m in methods if (system, m, n) in table]
    return min(there)[1] if there else None


def verdict(claim: str, good: bool | None, why: str) -> str:
    """Return a claim with its verdict as a line of Markdown; None: what it is about was not run."""
    word = {True: "holds", False: "DOES NOT HOLD", None: "not judged"}[good]
    return f"* {word}: {claim} ({why})"


def draw(path: Path, panels: Sequence[tuple[str, str, Table]], labels: dict[str, str], columns: int) -> None:
    """Draw a metric against training size, a line with the spread over model seeds for every method.

    Args:
        path: of the PNG.
        panels: (system, metric, table) of every axis.
        labels: metric -> label of its axis.
        columns: of axes.
    """
    every = list(dict.fromkeys(m for system, _, table in panels for m in methods_of(table, system)))
    figure, axes = new_figure(len(panels), 3.6, 3.0, columns=columns)
    for axis, (system, metric, table) in zip(axes, panels, strict=True):
        tops = []
        for method in methods_of(table, system):
            sizes = [n for n in sizes_of(table, system) if (system, method, n) in table]
            middle = np.array([table[system, method, n].mean for n in sizes])
            half = np.array([table[system, method, n].spread for n in sizes])
            style = line_style(every.index(method)) | {"marker": "o", "markevery": 1}
            axis.fill_between(sizes, middle - half, middle + half, color=style["color"], alpha=0.2, linewidth=0)
            axis.plot(sizes, middle, label=method, **style)
            tops.append(middle)
        sizes = sizes_of(table, system)
        axis.set(title=system, xlabel="training transitions", ylabel=labels[metric], xscale="log")
        axis.set_xticks(sizes, [str(n) for n in sizes])
        axis.minorticks_off()
        if metric == "nll":
            values = np.concatenate(tops)
            low = np.nanmin(values)
            # lines far above the best would flatten the others into one
            span = 3 * max(np.nanmedian(values) - low, 1.0)
            axis.set_ylim(low - 0.08 * span, min(np.nanmax(values), low + span) + 0.05 * span)
        else:
            ratio_scale(axis)
    legend_below(figure, axes[0])
    save(figure, path)


def markdown(table: Table, systems: Iterable[str], best: Callable[[Iterable[float]], float] = min) -> list[str]:
    """Return tables of mean and spread, a row per method, the best of every size in bold."""
    lines = []
    for system in systems:
        sizes = sizes_of(table, system)
        lines += [
            "",
            f"### {system}",
            "",
            f"| | {' | '.join(f'n = {n}' for n in sizes)} |",
            "|---" * (len(sizes) + 1) + "|",
        ]
        methods = methods_of(table, system)
        winner = {n: best(table[system, m, n].mean for m in methods if (system, m, n) in table) for n in sizes}
        for method in methods:
            cells = []
            for n in sizes:
                cell = table.get((system, method, n))
                if cell is None:
                    cells.append("-")
                    continue
                text = f"{cell.mean:.3g} ± {cell.spread:.2g}"
                cells.append(f"**{text}**" if cell.mean == winner[n] else text)
            lines.append(f"| {method} | {' | '.join(cells)} |")
    return lines
