"""Figures of control: learning curves, paths in the true simulator, an animation of the manoeuvre. From Parquet only."""

from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.reporting.figures.canvas import (
    BLACK,
    COLOURS,
    DASHES,
    distinct,
    legend_below,
    new_figure,
    save,
    with_unit,
)
from simpel_cli.runs.files import read_columns, read_units, replacing
from simpel_cli.runs.metrics import read_metrics

SHOWN = 20  # paths of episodes
FRAMES = 100
DURATION = 67  # of a frame, ms


def draw_control(directory: Path) -> list[Path]:
    """Draw the figures of a run from its Parquet files; of a car in the plane an animation, too."""
    made = []
    rows = [r for r in read_metrics(directory / "metrics.parquet") if r["split"] == "train"]
    if rows:
        made.append(save(_curves(rows), directory / "learning_curves.png"))
    path = directory / "episodes.parquet"
    if path.exists():
        table, units = read_columns(path), read_units(path)
        made.append(save(_paths(table, units), directory / "trajectories.png"))
        if {"x", "y", "theta"} <= set(table):
            made.append(_film(_median(table), units, directory / "manoeuvre.gif"))
    return made


def draw_online(directory: Path) -> list[Path]:
    """Draw the figures of an online run: returns by episode, paths of the episodes, an animation of the last."""
    made = [save(_returns(read_metrics(directory / "metrics.parquet")), directory / "returns.png")]
    files = sorted((directory / "episodes").glob("*.parquet"))
    tables = [read_columns(path) for path in files]
    made.append(save(_courses(tables, read_units(files[0])), directory / "trajectories.png"))
    if {"x", "y", "theta"} <= set(tables[-1]):
        last = tables[-1] | {"step": np.arange(len(tables[-1]["x"]))}
        made.append(_film(last, read_units(files[-1]), directory / "manoeuvre.gif"))
    return made


def _returns(rows: list[dict[str, Any]]) -> Any:
    figure, axes = new_figure(2, 4.2, 3.2)
    for i, (metric, label) in enumerate((("return", "in the plant"), ("return_in_model", "predicted by the model"))):
        line = [(r["step"], r["value"]) for r in rows if r["metric"] == metric]
        axes[0].plot(*zip(*line, strict=True), color=COLOURS[i], marker="o", markersize=4, linewidth=1.2, label=label)
    axes[0].set(title="return", xlabel="episode", ylabel="return")
    legend_below(figure, axes[0])
    line = [(r["step"], r["value"]) for r in rows if r["metric"] == "nll_before"]
    axes[1].plot(*zip(*line, strict=True), color=COLOURS[2], marker="o", markersize=4, linewidth=1.2)
    axes[1].set(title="NLL before training on the episode", xlabel="episode", ylabel="nat")
    for axis in axes:
        axis.locator_params(axis="x", integer=True)
    return figure


def _courses(tables: list[dict[str, np.ndarray]], units: dict[str, str]) -> Any:
    """Course of every episode, later ones darker, the last in colour."""
    plane = {"x", "y"} <= set(units)
    left_out = ("t", "reward", "good", *(("x", "y") if plane else ()))
    names = [n for n in units if n not in left_out]
    figure, axes = new_figure(len(names) + plane, columns=3)
    for k, table in enumerate(tables):
        last = k == len(tables) - 1
        style = {
            "color": COLOURS[1] if last else BLACK,
            "alpha": 1.0 if last else 0.15 + 0.5 * k / len(tables),
            "linewidth": 1.0,
        }
        label = "last episode" if last else "earlier episodes (later: darker)" if k == 0 else None
        if plane:
            axes[0].plot(table["x"], table["y"], label=label, **style)
        for axis, name in zip(axes[plane:], names, strict=True):
            axis.plot(table["t"], _course(table[name], units[name]), label=None if plane else label, **style)
    if plane:
        axes[0].plot(0, 0, "+", color=BLACK, markersize=10)
        axes[0].set(title="paths", xlabel=with_unit("x", units["x"]), ylabel=with_unit("y", units["y"]))
        axes[0].set_aspect("equal", adjustable="datalim")
    for axis, name in zip(axes[plane:], names, strict=True):
        axis.set(title=name, xlabel=with_unit("t", "s"), ylabel=with_unit(name, units[name]))
    if len(tables) > 1:
        legend_below(figure, axes[0])
    return figure


def _course(values: np.ndarray, unit: str) -> np.ndarray:
    """Angles are unwrapped."""
    return np.unwrap(values) if unit == "rad" else values


def _curves(rows: list[dict[str, Any]]) -> Any:
    labels = {"return_in_model": "in the model", "return_in_truth": "in the true simulator"}
    figure, axes = new_figure(1, 5.0, 3.4)
    for i, (metric, label) in enumerate(labels.items()):
        own = [r for r in rows if r["metric"] == metric]
        for j, key in enumerate(distinct((r["seed"], r["output"]) for r in own)):
            line = [(r["step"], r["value"]) for r in own if (r["seed"], r["output"]) == key]
            style = {"color": COLOURS[i], "linestyle": DASHES[j % len(DASHES)], "linewidth": 1, "alpha": 0.8}
            axes[0].plot(*zip(*line, strict=True), label=label if j == 0 else None, **style)
    axes[0].set(title="learning curve, one dash style per policy", xlabel="steps in the model", ylabel="return")
    legend_below(figure, axes[0])
    return figure


def _paths(table: dict[str, np.ndarray], units: dict[str, str]) -> Any:
    first = table["seed"] == table["seed"][0]
    names = [n for n in units if n not in ("x", "y")] if {"x", "y"} <= set(units) else list(units)
    plane = {"x", "y"} <= set(units)
    figure, axes = new_figure(len(names) + plane, columns=3)
    for episode in distinct(table["episode"][first])[:SHOWN]:
        own = first & (table["episode"] == episode) & table["counts"].astype(bool)
        order = np.argsort(table["step"][own])
        style = {"color": COLOURS[0], "alpha": 0.4, "linewidth": 0.9}
        if plane:
            axes[0].plot(table["x"][own][order], table["y"][own][order], **style)
        for axis, name in zip(axes[plane:], names, strict=True):
            axis.plot(table["step"][own][order], _course(table[name][own][order], units[name]), **style)
    if plane:
        axes[0].plot(0, 0, "+", color=BLACK, markersize=10)
        axes[0].set(
            title="paths in the true simulator", xlabel=with_unit("x", units["x"]), ylabel=with_unit("y", units["y"])
        )
        axes[0].set_aspect("equal", adjustable="datalim")
    for axis, name in zip(axes[plane:], names, strict=True):
        axis.set(title=name, xlabel="step", ylabel=with_unit(name, units[name]))
    return figure


def _median(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the course of the first seed's episode of the median return."""
    first = table["seed"] == table["seed"][0]
    numbers = distinct(table["episode"][first])
    returns = [table["reward"][first & (table["episode"] == e)].sum() for e in numbers]
    median = numbers[int(np.argsort(returns)[len(returns) // 2])]
    own = first & (table["episode"] == median)
    order = np.argsort(table["step"][own])
    return {name: table[name][own][order] for name in ("step", "x", "y", "theta")}


def _film(table: dict[str, np.ndarray], units: dict[str, str], path: Path) -> Path:
    """Draw the course of x, y and theta as a car on the plane, with the steps counted above it."""
    from PIL import Image

    x, y, theta, step = (table[name] for name in ("x", "y", "theta", "step"))
    every = max(1, len(x) // FRAMES)
    figure, (axis,) = new_figure(1, 4.5, 4.0)
    margin = 0.5
    axis.set(
        xlim=(min(x.min(), 0) - margin, max(x.max(), 0) + margin), ylim=(min(y.min(), 0) - margin, max(y.max(), 0) + margin),
        aspect="equal", xlabel=with_unit("x", units["x"]), ylabel=with_unit("y", units["y"]), title="step",
    )  # fmt: skip
    axis.plot(0, 0, "+", color=BLACK, markersize=12)
    (trail,) = axis.plot([], [], color=COLOURS[0], linewidth=1)
    (car,) = axis.plot([], [], color=COLOURS[1], linewidth=2)
    outline = np.array([[-0.15, -0.08], [0.15, -0.08], [0.22, 0], [0.15, 0.08], [-0.15, 0.08], [-0.15, -0.08]])

    frames = []
    for k in range(0, len(x), every):
        turn = np.array([[np.cos(theta[k]), np.sin(theta[k])], [-np.sin(theta[k]), np.cos(theta[k])]])
        trail.set_data(x[: k + 1], y[: k + 1])
        car.set_data(*(outline @ turn + [x[k], y[k]]).T)
        axis.set_title(f"step {step[k]}")
        figure.canvas.draw()
        frames.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3]))
    with replacing(path) as temporary:
        frames[0].save(temporary, format="GIF", save_all=True, append_images=frames[1:], duration=DURATION, loop=0)
    return path
