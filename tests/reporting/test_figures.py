"""Figures as a person sees them: nothing cut, no legend over a curve, no two curves alike, and the right course shown."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from simpel_cli.reporting.figures import run
from simpel_cli.reporting.figures.canvas import new_figure, ratio_scale
from simpel_cli.runs.files import write_table
from simpel_cli.runs.metrics import read_metrics, write_metrics

MANY = tuple(f"position_of_joint_{i}" for i in range(15))
LEVELS = np.arange(0.05, 0.951, 0.05)
CONSTANTS = {"run": "r", "command": "fit", "experiment": "e", "method": "m", "sim": "s", "data": "d", "n_train": 3}


def repeated(outputs: tuple[str, ...], n: int, **columns: Any) -> dict[str, Any]:
    """Columns of a table with n rows per output; a row of `columns` is for all outputs."""
    spread = {name: np.tile(value, len(outputs)) for name, value in columns.items()}
    return {"seed": np.zeros(n * len(outputs), int), "output": np.repeat(outputs, n), **spread}


def metrics(folder: Path, outputs: tuple[str, ...]) -> Path:
    rows = [
        {"seed": s, "step": step, "split": "train", "metric": m, "output": o, "unit": u, "value": 1 + 1 / step}
        for s in (0, 1)
        for step in range(50, 501, 50)
        for m, o, u in [("loss", "", "nat"), *(("noise_std", o, "rad/s") for o in outputs)]
    ]
    return write_metrics(folder / "metrics.parquet", rows, CONSTANTS)


def calibration(folder: Path, outputs: tuple[str, ...]) -> Path:
    table = repeated((*outputs, "joint"), len(LEVELS), level=LEVELS, fraction=LEVELS**1.1)
    write_table(folder / "calibration.parquet", table)
    return folder / "calibration.parquet"


def predictions(folder: Path, outputs: tuple[str, ...], *, kind: str = "change", time: Any = None) -> Path:
    t = np.arange(30) * 0.1 if time is None else time
    table = repeated(
        outputs, len(t), episode=["a"] * len(t), segment=[1] * len(t), row=np.arange(len(t)), time=t, unit=["m"] * len(t),
        kind=[kind] * len(t), measured=np.sin(t), mean=np.sin(t) + 0.1, std=0 * t + 0.2, epistemic_std=0 * t + 0.1,
    )  # fmt: skip
    write_table(folder / "predictions.parquet", table)
    return folder / "predictions.parquet"


def horizon(folder: Path, outputs: tuple[str, ...]) -> Path:
    t = np.arange(20) * 0.1
    table = repeated(outputs, len(t), horizon=t, unit=["m"] * 20, rmse=t, claimed_std=0.2 + t)
    write_table(folder / "horizon.parquet", table)
    return folder / "horizon.parquet"


def trajectories(folder: Path, outputs: tuple[str, ...], errors: tuple[float, ...] = (0.1, 0.3, 0.2)) -> Path:
    """One free run per error, in the first output; the others are exact."""
    t = np.arange(20) * 0.1
    parts = []
    for i, error in enumerate(errors):
        start = np.full(20, float(i))
        part = repeated(
            outputs, 20, episode=["a"] * 20, segment=[1] * 20, start=start, time=start + t, unit=["m"] * 20,
            measured=np.sin(t), mean=np.sin(t), std=0 * t + 0.2,
        )  # fmt: skip
        part["mean"] = part["mean"] + error * (part["output"] == outputs[0])
        parts.append(part)
    write_table(folder / "trajectories.parquet", {k: np.concatenate([p[k] for p in parts]) for k in parts[0]})
    return folder / "trajectories.parquet"


DRAWN = [
    (run._learning_curves, metrics), (run._calibration, calibration), (run._predictions, predictions),
    (run._horizon, horizon), (run._example, trajectories),
]  # fmt: skip


@pytest.mark.parametrize("outputs", [("phi",), ("phi", "omega"), MANY])
@pytest.mark.parametrize(("draw", "make"), DRAWN, ids=[d.__name__ for d, _ in DRAWN])
def test_nothing_is_cut_and_no_legend_lies_over_an_axis(
    draw: Callable[[Path], Any], make: Callable[..., Path], outputs: tuple[str, ...], tmp_path: Path
) -> None:
    figure = draw(make(tmp_path, outputs))
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    page = figure.bbox.padded(1.5)  # pixels
    legends = [*figure.legends, *(axis.get_legend() for axis in figure.axes if axis.get_legend())]
    assert legends
    texts = [t for a in figure.axes for t in (a.title, a.xaxis.label, a.yaxis.label)] + figure.texts
    for item in [*legends, *texts]:
        box = item.get_window_extent(renderer)
        assert page.x0 <= box.x0 <= box.x1 <= page.x1, item
        assert page.y0 <= box.y0 <= box.y1 <= page.y1, item
    for axis in figure.axes:
        inside = axis.get_window_extent(renderer)
        assert inside.width > 120, "no room is left for the curves"
        assert inside.height > 80
        for legend in legends:
            assert not legend.get_window_extent(renderer).overlaps(inside)


def test_curves_of_many_outputs_can_be_told_apart(tmp_path: Path) -> None:
    (axis,) = run._calibration(calibration(tmp_path, MANY)).axes
    lines = [line for line in axis.lines if not line.get_label().startswith("_")]
    assert len(lines) == len(MANY) + 1
    assert len({(line.get_color(), line.get_linestyle(), line.get_marker()) for line in lines}) == len(lines)


def test_the_example_is_the_run_with_the_median_error(tmp_path: Path) -> None:
    path = trajectories(tmp_path, ("phi", "omega"), (0.1, 0.5, 0.2, 0.4, 0.3))
    figure = run._example(path)
    assert "test episode a from 4 s: median error of 5 runs" in figure._suptitle.get_text()
    curve = next(line for line in figure.axes[0].lines if line.get_label() == "predicted")
    np.testing.assert_allclose(curve.get_ydata() - np.sin(np.arange(20) * 0.1), 0.3, rtol=1e-9)
    np.testing.assert_allclose(curve.get_xdata(), 4 + np.arange(20) * 0.1)


def test_values_of_a_static_simulator_are_not_called_changes(tmp_path: Path) -> None:
    moving = run._predictions(predictions(tmp_path, ("phi",))).axes[0]
    assert (moving.get_title(), moving.get_ylabel()) == ("phi", "change in one step [m]")
    assert moving.get_xlabel() == "time [s]"
    still = run._predictions(predictions(tmp_path, ("f",), kind="value")).axes[0]
    assert (still.get_xlabel(), still.get_ylabel()) == ("measured value [m]", "predicted value [m]")
    shuffled = np.random.default_rng(0).permutation(30) ** 2 * 0.1  # rows of which none follows another
    loose = run._predictions(predictions(tmp_path, ("phi",), time=shuffled)).axes[0]
    assert loose.get_xlabel() == "measured change in one step [m]"


def test_tables_of_a_run_are_drawn(tmp_path: Path) -> None:
    for _, make in DRAWN:
        make(tmp_path, ("phi",))
    drawn = run.draw_run(tmp_path)
    assert [p.stem for p in drawn] == ["learning_curves", "predictions", "calibration", "free_run", "free_run_example"]
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in drawn)
    assert pq.read_table(tmp_path / "trajectories.parquet").num_rows == 60


@pytest.mark.parametrize(("kernels", "panels"), [([0.2, 0.6, 0.9], 3), ([0.5, 0.501, 0.5], 2), ([0.0, 0.0, 0.0], 2)])
def test_distance_between_particles_is_drawn_where_the_kernel_tells_it(
    tmp_path: Path, kernels: list[float], panels: int
) -> None:
    path = metrics(tmp_path, ("a",))
    rows = [r for r in read_metrics(path) if r["metric"] != "mean_kernel"]
    like = next(r for r in rows if r["metric"] == "loss")
    steps = [r["step"] for r in rows if r["metric"] == "loss" and r["seed"] == like["seed"]][:3]
    between = [like | {"metric": "mean_kernel", "step": s, "value": k} for s, k in zip(steps, kernels, strict=True)]
    figure = run._learning_curves(write_metrics(path, rows + between, {}))
    assert len(figure.axes) == panels
    if panels == 3:
        drawn = figure.axes[1].lines[0].get_ydata()
        np.testing.assert_allclose(np.exp(-(np.asarray(drawn) ** 2) / 2), kernels, rtol=1e-9)


@pytest.mark.parametrize("low", [0.4, 0.03, 1e-4, 1e-9, 1e-15])
def test_a_logarithmic_axis_has_numbers_however_far_it_reaches(low: float) -> None:
    axis = new_figure(1)[1][0]
    axis.plot([0, 1], [low, 1.0])
    ratio_scale(axis)
    axis.figure.canvas.draw()
    bottom, top = axis.get_ylim()
    shown = [t.get_text() for t in axis.get_yticklabels() if bottom <= t.get_position()[1] <= top]
    assert 2 <= len([text for text in shown if text]) <= 12
