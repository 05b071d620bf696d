"""The figure of a sweep: lines that lie together stay apart for the eye, and one far off is noted, not followed."""

from pathlib import Path

import numpy as np
import pytest

from simpel_cli.reporting.figures import draw_sweep, sweep
from simpel_cli.runs.metrics import write_metrics

SIZES = (10, 20)


def line(name: str, *values: float) -> sweep.Line:
    middle = np.array(values)
    return sweep.Line(name, np.arange(len(values)), middle - 0.1, middle, middle + 0.1)


@pytest.mark.parametrize(
    ("lines", "shown"),
    [
        ([line("a", -9.0, -9.2), line("b", -8.5, -8.6)], 2),
        ([line("a", -9.0, -9.2), line("b", -8.5, -8.6), line("c", 90.0, -7.0)], 2),
        ([line("c", 90.0, 50.0), line("a", -9.0, -9.2)], 1),
        ([line("a", -9.0, -9.2), line("b", -6.0, -8.6), line("c", 4.0, 2.0)], 3),  # a fall over three lines is followed
        ([line("c", 90.0, -7.0)], 1),
    ],
)
def test_view(lines: list[sweep.Line], shown: int) -> None:
    bottom, top = sweep.view(lines)
    assert bottom <= min(each.low.min() for each in lines)
    kept = sorted(each.high.max() for each in lines)[:shown]
    if shown == len(lines):
        assert top is None
    else:
        assert top is not None
        assert kept[-1] < top < min(each.high.max() for each in lines if each.high.max() not in kept)
        assert top - bottom < 2 * max(kept[-1] - bottom, 1.0)  # the lines that lie together fill half of it


def test_a_line_far_off_is_noted_with_its_median(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nll = {"simpel": (-9.0, -9.3), "simpel_only_sim": (-8.5, -8.6), "fsvgd": (90.0, 12.0)}
    nrmse = {"simpel": (0.06, 0.05), "simpel_only_sim": (0.07, 0.06), "fsvgd": (0.4, 0.2)}
    rows = [
        {
            "run": f"method={method} data.n_train={n}", "command": "fit", "experiment": "e", "data": "d", "method": method,
            "n_train": n, "seed": seed, "step": 1, "split": "test", "metric": metric, "output": "joint", "unit": "1",
            "value": table[method][i] * (1 + 0.01 * seed),
        }
        for metric, table in (("nll", nll), ("nrmse", nrmse))
        for method in nll
        for i, n in enumerate(SIZES)
        for seed in (0, 1, -1)
    ]  # fmt: skip
    figures = []
    monkeypatch.setattr(sweep, "save", lambda figure, path: figures.append(figure) or path)
    path = draw_sweep(write_metrics(tmp_path / "sweep.parquet", rows, {}))
    assert path == tmp_path / "metrics_vs_n_train.png"
    left, right = figures[0].axes
    assert (left.get_ylabel(), right.get_ylabel()) == ("test NLL [nat]", "test RMSE, normalised")
    low, high = left.get_ylim()
    assert low < -9.3
    assert -8.5 < high < 0
    assert [t.get_text() for t in left.texts] == ["↑ 90", "↑ 12"]
    assert [t.xy[0] for t in left.texts] == list(SIZES)
    assert right.get_yscale() == "log"
    assert not right.texts
    (legend,) = figures[0].legends
    assert [t.get_text() for t in legend.get_texts()] == list(nll)
    assert draw_sweep(write_metrics(tmp_path / "none.parquet", [], {})) is None
