"""Means over seeds, differences in pairs, and `simpel report` on Parquet files alone."""

import csv
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command_line import simpel

from simpel_cli.evaluation.comparison import Mean, Metric, best, difference, mean
from simpel_cli.runs.files import write_table
from simpel_cli.runs.metrics import read_metrics, write_metrics

SIZES, SEEDS = (10, 40), (0, 1, 2)
LEVEL = {("simpel", 10): -8.0, ("simpel", 40): -9.0, ("fsvgd", 10): 20.0, ("fsvgd", 40): -8.9}
NOISE = {0: 0.3, 1: -0.2, 2: -0.1}  # of a seed, the same for all methods: it cancels in pairs


def row(metric: str, value: float, **more: object) -> dict[str, object]:
    base = {"command": "fit", "experiment": "pend_ulum", "data": "d", "split": "test", "output": "joint", "unit": "1"}
    return base | {"step": 9, "metric": metric, "value": value} | more


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Fits of two methods, two sizes and three seeds, of which nothing was kept but Parquet, and a run that failed."""
    for (method, n), level in LEVEL.items():
        for seed in SEEDS:
            folder = tmp_path / "fits" / f"{method}-{n}-{seed}"
            folder.mkdir(parents=True)
            own = {"method": method, "n_train": n, "seed": seed}
            rows = [row("nll", level + NOISE[seed] + 0.01 * seed, **own), row("coverage_90", 0.9, **own)]
            rows += [row("loss", 5.0 / k, split="train", output="", **own | {"step": k}) for k in (1, 2, 3)]
            write_metrics(folder / "metrics.parquet", rows, {})
            levels = [0.5, 0.9]
            write_table(folder / "calibration.parquet", {"output": ["joint"] * 2, "level": levels, "fraction": levels})
    failed = tmp_path / "fits" / "broken"
    failed.mkdir()
    (failed / "manifest.json").write_text(json.dumps({"command": "fit", "status": "failed"}))
    return tmp_path / "fits"


def test_intervals_are_student_s() -> None:
    values = np.array([1.0, 2.0, 4.0])
    found = mean(values)
    half = 4.302653 * values.std(ddof=1) / 3**0.5  # the 0.975 quantile with two degrees of freedom
    np.testing.assert_allclose(found[:3], (values.mean(), values.mean() - half, values.mean() + half), rtol=1e-6)
    assert np.isnan(mean([3.0]).low)
    assert not mean([3.0]).certain
    assert mean([3.0, 3.1]).certain


def test_an_interval_of_shares_ends_where_shares_do() -> None:
    coverage = Metric("coverage_90", "", 0, 0, 1)
    assert mean([0.9, 0.99]).high > 1
    assert coverage.over([0.9, 0.99]) == mean([0.9, 0.99])._replace(high=1)
    assert coverage.over([0.9, 0.91]) == mean([0.9, 0.91])
    assert np.isnan(coverage.over([0.9]).low)


def test_pairs_share_their_seeds() -> None:
    assert difference({0: 3.0, 1: 5.0, 7: 99.0}, {0: 2.0, 1: 4.0, 8: -99.0})[:3] == (1.0, 1.0, 1.0)
    assert np.isnan(difference({0: 1.0}, {1: 1.0}).value)


def test_best() -> None:
    cells = {("a", 1): {0: 1.0, 1: 2.0}, ("b", 1): {0: 2.0, 1: 3.1}, ("c", 1): {0: float("nan")}, ("b", 2): {0: 1.0}}
    low, alone = best(cells, Metric("nll", "", -1))
    assert (low.variant, low.second, alone.variant, alone.second) == ("a", "b", "b", "")
    assert low.lead.value == pytest.approx(1.05)
    assert isinstance(low.lead, Mean)
    assert low.lead.low < 1.05 < low.lead.high
    high, _ = best(cells, Metric("return", "", 1))
    assert (high.variant, high.lead.value) == ("b", pytest.approx(1.05))


def test_report_of_parquet_files(runs: Path, tmp_path: Path) -> None:
    result = simpel(tmp_path, "report", "fits", "--out", "fits")
    assert (result.code, result.err) == (0, "")
    # 0.1 apart in every seed: certain in pairs, though the seeds differ by 0.5
    assert "pend_ulum: simpel has the best test NLL [nat] at n = 40, ahead of fsvgd by 0.1" in result.out
    page = (runs / "report.html").read_text()
    for words in ("12 finished runs of 2 methods, 3 seeds", "broken", "failed", "learning curves", "calibration"):
        assert words in page
    assert page.count("data:image/png") == 3
    assert "http" not in page.replace("http://www.w3.org", "")  # self-contained
    with (runs / "tables" / "fit-pend_ulum-nll-differences.csv").open() as file:
        found = {int(r["n_train"]): r for r in csv.DictReader(file)}
    assert float(found[10]["difference"]) == pytest.approx(28.0)
    assert float(found[40]["low"]) == pytest.approx(0.1, abs=1e-6)
    assert found[40]["baseline"] == "simpel"
    latex = (runs / "tables" / "fit-pend_ulum-nll.tex").read_text()
    assert r"\caption{pend\_ulum: test NLL [nat]}" in latex
    assert latex.count(r"\\") == 3
    # again, over itself, against the other; a sweep's table alone says the same
    result = simpel(tmp_path, "report", "fits", "--baseline", "fsvgd", "--out", "there")
    assert result.code == 0
    assert "minus fsvgd" in (tmp_path / "there" / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("report", "nowhere"), "report: nowhere is no directory."),
        (("report", "."), "holds no runs"),
        (("report", "fits/broken"), "none of the 1 runs is complete with readable metrics (1 failed)"),
        (
            ("report", "fits", "--baseline", "simple"),
            "--baseline: got simple; no run has this method. Did you mean simpel?",
        ),
        (("report", "fits", "--out", "file"), "--out: cannot write to file"),
        (("report", "fits", "--out", "fits/broken"), "--out: fits/broken is the directory of a run"),
    ],
)
def test_wrong_reports(runs: Path, tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    result = simpel(tmp_path / "empty" if words[1] == "." else tmp_path, *words)
    assert result.code == 2
    assert message in result.err


def test_a_folder_of_runs_is_left_as_it_is(runs: Path, tmp_path: Path) -> None:
    before = sorted(runs.iterdir())
    (runs / "report.html").write_text("mine")
    result = simpel(tmp_path, "report", "fits")
    (written,) = (tmp_path / "runs" / "report").glob("*/report.html")
    assert f"report    {written.relative_to(tmp_path)}" in result.out
    assert (runs / "report.html").read_text() == "mine"
    assert sorted(p for p in runs.iterdir() if p.name != "report.html") == before


def test_only_words_that_tell_runs_of_one_panel_apart_are_in_their_names(runs: Path, tmp_path: Path) -> None:
    for i, folder in enumerate(sorted(runs.glob("*-10-*"))):
        (folder / ".hydra").mkdir()
        words = ["score=kde", f"prior.draws={64 * (1 + i % 2)}"]
        (folder / ".hydra" / "overrides.yaml").write_text(json.dumps(words))
        if i % 2:  # of another experiment, all alike
            rows = [r | {"experiment": "cart"} for r in read_metrics(folder / "metrics.parquet")]
            write_metrics(folder / "metrics.parquet", rows, {})
    for folder in runs.glob("*-40-*"):
        shutil.rmtree(folder)
    assert simpel(tmp_path, "report", "fits", "--out", "there").code == 0
    page = (tmp_path / "there" / "report.html").read_text()
    assert ("score=kde" in page, "prior.draws" in page) == (False, False)


def test_a_damaged_run_costs_itself_only(runs: Path, tmp_path: Path) -> None:
    (runs / "simpel-10-0" / "metrics.parquet").write_bytes(b"PAR1 and nothing else")
    (runs / "simpel-10-1" / "calibration.parquet").write_bytes(b"")
    result = simpel(tmp_path, "report", "fits", "--out", "fits")
    assert result.code == 0
    page = (runs / "report.html").read_text()
    assert "done, metrics not readable" in page
    assert "Mean over 2 to 3 seeds." in page


LOOK = """<script>addEventListener("load", () => {
  const images = [...document.images].filter(image => image.naturalWidth > 50).length;
  const wide = document.documentElement.scrollWidth > innerWidth;
  document.title = `images ${images} tables ${document.querySelectorAll("table").length} wide ${wide}`;
});</script>"""


@pytest.mark.browser
def test_report_in_a_browser(runs: Path, tmp_path: Path) -> None:
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no Chromium here")
    assert simpel(tmp_path, "report", "fits", "--out", "fits").code == 0
    page = tmp_path / "page.html"
    page.write_text((runs / "report.html").read_text().replace("</head>", LOOK + "</head>"))
    words = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={tmp_path / 'chromium'}",
        "--window-size=900,900",
    ]
    words += ["--disable-background-networking", "--virtual-time-budget=5000", "--dump-dom"]
    shown = subprocess.run([browser, *words, page.as_uri()], capture_output=True, text=True, timeout=120)
    title = re.search("<title>(.*?)</title>", shown.stdout)
    assert title is not None, shown.stderr
    assert title[1] == "images 3 tables 6 wide false"
