"""The paper's control experiments: reverse parking of an RC car, from recorded drives and from episodes of the policy's own.

    python -m tests.reproduce.control offline --size small --out runs/reproduce/offline
    python -m tests.reproduce.control online --size small --out runs/reproduce/online
    simpel discover experiment=rc_car_parking 'effect=[vehicle]' close=false hydra.run.dir=DIR
    python -m tests.reproduce.control online --corrected DIR --methods simpel simpel_corrected

Offline: return in the true car (100 episodes of 200 steps) of a policy that was learned in a posterior of n transitions of
recorded drives without noise. Online: return of every episode of 100 steps, the first of which knows the prior alone. A
method's seed is that of its data, its networks and its policies. As published the priors know the delay of the commands; the
true car has tyres that slip, as `simpel_high_fidelity` knows, and the others do not.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.stats

from simpel_cli.reporting.figures.canvas import legend_below, line_style, new_figure, save
from simpel_cli.runs.files import read_columns, write_table, write_text
from tests.reproduce.panel import CONF, Fit, run, tested, verdict
from tests.reproduce.static import folder

LOW, HIGH = "parking_bicycle", "parking_high_fidelity"
METHODS = {  # name -> (method of simpel, simulator)
    "simpel": ("simpel", LOW),
    "simpel_high_fidelity": ("simpel_high_fidelity", HIGH),
    "fsvgd": ("fsvgd", LOW),
    "greybox": ("greybox", LOW),
    "sysid": ("sysid", LOW),
    "pathwise": ("pathwise", LOW),
}
CORRECTED = "simpel_corrected"  # with the simulator that a run of `discover` left
SIZES = {"small": (50, 200, 1000), "full": (20, 50, 200, 1000)}
SEEDS = {"small": 2, "full": 5}
ONLINE = ("simpel", "fsvgd", "pathwise", "sysid")
SHARE = 0.8  # of the final return
LAST = 3  # episodes that are the end


def words_of(name: str, seed: int) -> list[str]:
    """Return the words of a method."""
    method, sim = METHODS[name]
    return ["experiment=rc_car_parking", f"sim={sim}", f"method={method}", f"run.seed={seed}", f"run.name={name}"]


def corrected(run: Path) -> Path:
    """Return the YAML of the simulator that a run of `discover` corrected."""
    found = sorted((run / "conf" / "sim").glob("*.yaml"))
    if len(found) != 1:
        raise SystemExit(
            f"--corrected {run}: holds {len(found)} corrected simulators; needed is the run of a verdict `effect`."
        )
    return found[0]


def jobs(what: str, methods: Sequence[str], size: str, seeds: int, episodes: int, conf: Path = CONF) -> list[Fit]:
    """Return every run of an experiment."""
    every = []
    for name in methods:
        for n in SIZES[size] if what == "offline" else (0,):
            for seed in range(seeds):
                words = words_of(name, seed)
                words += [f"data.n_train={n}"] if n else ["reward.horizon=100", f"online.episodes={episodes}"]
                every.append(Fit("parking", name, n, seed, tuple(words), f"rl-{what}", conf))
    return every


def interval(values: np.ndarray) -> str:
    """Return a mean with its 95 % interval over seeds."""
    if len(values) < 2:
        return f"{values.mean():.3g}"
    half = scipy.stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    return f"{values.mean():.3g} ± {half:.2g}"


def offline(every: Sequence[Fit], out: Path) -> list[str]:
    """Draw return against data size; return its table and the claims."""
    found: dict[tuple[str, int], np.ndarray] = {}
    rows = []
    for fit in every:
        if (out / fit.name / "metrics.parquet").exists():
            by = {r["metric"]: r["value"] for r in tested(out / fit.name)}
            rows.append((fit.method, fit.n_train, fit.data_seed, *(by[m] for m in METRICS)))
    if not rows:
        return []
    names = ("method", "n_train", "seed", *METRICS)
    write_table(out / "offline.parquet", {c: [row[i] for row in rows] for i, c in enumerate(names)})
    sizes, methods = sorted({r[1] for r in rows}), list(dict.fromkeys(r[0] for r in rows))
    lines = ["| | " + " | ".join(f"n = {n}" for n in sizes) + " |", "|---" * (len(sizes) + 1) + "|"]
    figure, (axis,) = new_figure(1, 5.0, 3.6)
    for i, method in enumerate(methods):
        cells = []
        for n in sizes:
            own = np.array([(r[4], r[5]) for r in rows if r[:2] == (method, n)])
            if len(own):
                found[method, n] = own[:, 0]
            cells.append(f"{interval(own[:, 0])}, {100 * own[:, 1].mean():.0f} %" if len(own) else "-")
        lines.append(f"| {method} | {' | '.join(cells)} |")
        there = [n for n in sizes if (method, n) in found]
        for n in there:
            axis.plot([n] * len(found[method, n]), found[method, n], ".", color=line_style(i)["color"], markersize=4)
        axis.plot(there, [found[method, n].mean() for n in there], label=method, **line_style(i) | {"marker": ""})
    axis.set(xscale="log", xlabel="transitions", ylabel="return in the true car", title="parking from recorded drives")
    axis.set_xticks(sizes, [str(n) for n in sizes])
    axis.minorticks_off()
    legend_below(figure, axis)
    save(figure, out / "offline.png")

    def mean(method: str, n: int) -> float:
        return float(found[method, n].mean()) if (method, n) in found else float("nan")

    def compared(own: str, other: str, at: Sequence[int], words: str) -> str:
        gaps = [mean(own, n) - mean(other, n) for n in at]
        why = "; ".join(f"n = {n}: {g:+.3g}" for n, g in zip(at, gaps, strict=True))
        return verdict(words, all(g > 0 for g in gaps) if np.isfinite(gaps).all() else None, why)

    few = sizes[: 1 if len(sizes) < 3 else 2]
    return [
        *lines, "", "Mean return ± 95 % over seeds, and episodes parked.", "",
        compared("simpel", "fsvgd", few, "SimPEL earns more than FSVGD where data are few"),
        compared("simpel", "sysid", sizes, "SimPEL earns more than the identified simulator"),
        compared("simpel_high_fidelity", "sysid", sizes, "the better prior earns more than the identified bicycle"),
    ]  # fmt: skip


METRICS = ("return_in_model", "return_in_truth", "success")


def online(every: Sequence[Fit], out: Path) -> list[str]:
    """Draw return against episode; return its table and the claims."""
    courses: dict[str, list[np.ndarray]] = {}
    closest: dict[str, list[np.ndarray]] = {}
    moved: dict[str, list[float]] = {}
    parked: dict[str, list[int]] = {}
    rows = []
    for fit in every:
        files = sorted((out / fit.name / "episodes").glob("*.parquet"))
        if not (out / fit.name / "report.html").exists():
            continue
        tables = [read_columns(path) for path in files]
        returns = np.array([t["reward"].sum() for t in tables])
        near = np.array([np.hypot(t["x"], t["y"]).min() for t in tables])
        courses.setdefault(fit.method, []).append(returns)
        closest.setdefault(fit.method, []).append(near)
        moved.setdefault(fit.method, []).append(float(np.hypot(np.diff(tables[0]["x"]), np.diff(tables[0]["y"])).sum()))
        good = [bool(t["good"][-11:-1].all()) for t in tables]
        parked.setdefault(fit.method, []).append(good.index(True) + 1 if any(good) else 0)
        rows += [(fit.method, fit.data_seed, k, r, d) for k, (r, d) in enumerate(zip(returns, near, strict=True))]
    if not rows:
        return []
    names = ("method", "seed", "episode", "return", "closest")
    write_table(out / "online.parquet", {c: [row[i] for row in rows] for i, c in enumerate(names)})
    figure, axes = new_figure(2, 4.6, 3.4)
    for i, method in enumerate(courses):
        for axis, values in zip(axes, (courses[method], closest[method]), strict=True):
            values = np.array(values)
            at, style = np.arange(1, values.shape[1] + 1), line_style(i) | {"marker": ""}
            axis.fill_between(at, values.min(axis=0), values.max(axis=0), color=style["color"], alpha=0.15, linewidth=0)
            axis.plot(at, values.mean(axis=0), label=method, **style)
    axes[0].set(title="parking from nothing", xlabel="episode", ylabel="return of 100 steps")
    axes[1].set(title="closest to the goal", xlabel="episode", ylabel="distance [m]")
    legend_below(figure, axes[0])
    save(figure, out / "online.png")
    best = max(np.array(v)[:, -LAST:].mean() for v in courses.values())
    first = {
        m: [int(np.argmax(c >= SHARE * best)) + 1 if (c >= SHARE * best).any() else 0 for c in v]
        for m, v in courses.items()
    }
    lines = [
        f"| | last {LAST} episodes | first of {100 * SHARE:.0f} % of {best:.3g} | closest in episode 3, m | first parked "
        "| way in episode 1, m |",
        "|---|---|---|---|---|---|",
    ]
    for method, values in courses.items():
        ends = np.array(values)[:, -LAST:].mean(axis=1)
        lines.append(
            f"| {method} | {interval(ends)} | {_counted(first[method])} | {interval(np.array(closest[method])[:, 2])} | "
            f"{_counted(parked[method])} | {interval(np.array(moved[method]))} |"
        )
    lines += [
        "",
        "Mean ± 95 % over seeds; episodes by seed, - where there is none. The best mean end of any method is the 100 %.",
        "",
    ]
    if {"simpel", "fsvgd"} <= set(courses):
        own, other = ([x or np.inf for x in first[m]] for m in ("simpel", "fsvgd"))
        good = float(np.median(other)) >= 2 * float(np.median(own)) if np.isfinite(np.median(own)) else False
        lines.append(
            verdict(
                "SimPEL needs half of FSVGD's episodes", good, f"medians {np.median(own):g} and {np.median(other):g}"
            )
        )
    for method in courses:
        near = float(np.array(closest[method])[:, 2].mean())
        lines.append(verdict(f"{method} comes near the goal within three episodes", near < 0.3, f"{near:.2f} m"))
        count = sum(0 < e <= 10 for e in parked[method])
        lines.append(
            verdict(
                f"{method} parks by episode 10", count == len(parked[method]), f"{count} of {len(parked[method])} seeds"
            )
        )
    return lines


def _counted(episodes: Sequence[int]) -> str:
    return ", ".join(str(e) if e else "-" for e in episodes)


def main() -> None:
    """Run, draw and judge."""
    parser = argparse.ArgumentParser(prog="tests.reproduce.control", description=__doc__)
    parser.add_argument("what", choices=("offline", "online"))
    parser.add_argument("--size", choices=tuple(SIZES), default="small")
    parser.add_argument("--corrected", type=Path, help="run of discover, for simpel_corrected")
    parser.add_argument("--methods", nargs="+", choices=[*METHODS, CORRECTED])
    parser.add_argument("--seeds", type=int, help="small: 2, full: 5")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    out = folder(asked.out, asked.what)
    conf = CONF
    if asked.corrected is not None:
        sim = corrected(asked.corrected)
        METHODS[CORRECTED], conf = ("simpel", sim.stem), sim.parents[1].absolute()
    methods = asked.methods or (list(METHODS) if asked.what == "offline" else list(ONLINE))
    if CORRECTED in methods and CORRECTED not in METHODS:
        parser.error("simpel_corrected needs --corrected DIR")
    every = jobs(asked.what, methods, asked.size, asked.seeds or SEEDS[asked.size], asked.episodes, conf)
    run(every, out, asked.processes)
    lines = (offline if asked.what == "offline" else online)(every, out)
    write_text(out / f"{asked.what}.md", "\n".join(lines) + "\n")
    print("\n".join(lines))
    print(f"\n{out}")


if __name__ == "__main__":
    main()
