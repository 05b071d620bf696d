"""Figures of control: the film shows the right episode from its first step to its last, and a report carries it."""

from pathlib import Path

import numpy as np
from PIL import Image

from simpel_cli.reporting.figures.control import draw_control
from simpel_cli.reporting.html import figure, write_report
from simpel_cli.runs.files import write_table
from simpel_cli.runs.metrics import write_metrics

CONSTANTS = {
    "run": "r",
    "command": "rl-offline",
    "experiment": "e",
    "method": "m",
    "sim": "s",
    "data": "d",
    "n_train": 3,
}
STEPS = 12


def drives(folder: Path) -> None:
    """Three episodes of one seed and one of another; the median return of the first seed is that of the second episode."""
    episode = np.repeat([0, 1, 2, 0], STEPS)
    step = np.tile(np.arange(1, STEPS + 1), 4)
    turn = np.where(episode == 1, 3.0 + 0.1 * step, 0.0)  # runs over pi
    columns = {
        "seed": np.repeat([0, 0, 0, 1], STEPS), "episode": episode, "step": step,
        "x": 0.1 * step * (episode - 1), "y": 0.2 * step, "theta": (turn + np.pi) % (2 * np.pi) - np.pi,
        "steer": np.sin(step), "reward": 1.0 * episode, "good": step < 0, "counts": step > 0,
    }  # fmt: skip
    units = {"x": "m", "y": "m", "theta": "rad", "steer": "1"}
    write_table(folder / "episodes.parquet", columns, units)
    rows = [
        {"seed": 0, "step": k, "split": "train", "metric": "return_in_model", "output": "0", "unit": "", "value": k}
        for k in (1, 2)
    ]
    write_metrics(folder / "metrics.parquet", rows, CONSTANTS)


def test_the_film_is_of_the_median_episode_and_stands_in_the_report(tmp_path: Path) -> None:
    drives(tmp_path)
    made = draw_control(tmp_path)
    assert [path.name for path in made] == ["learning_curves.png", "trajectories.png", "manoeuvre.gif"]
    with Image.open(made[-1]) as film:
        assert film.n_frames == STEPS
        width = film.width
        film.seek(STEPS - 1)
        last = np.asarray(film.convert("RGB")).astype(int)
    # the median episode goes straight up from the cross: the orange outline ends above the middle of the axes
    orange = (last[..., 0] > 180) & (last[..., 1] < 130) & (last[..., 2] < 80)
    rows, columns = np.nonzero(orange)
    assert len(rows) > 20
    assert abs(columns.mean() / width - 0.55) < 0.1
    section = figure(made[-1], "control/manoeuvre")
    assert section["title"] == "Manoeuvre"
    assert section["width"] == width
    page = write_report(tmp_path / "report.html", title="t", lead="l", sections=[section], commands=[], config="a: 1")
    assert "data:image/gif;base64,R0lGOD" in page.read_text()
    assert figure(made[0], "control/learning_curves")["image"].startswith("png;base64,iVBOR")
