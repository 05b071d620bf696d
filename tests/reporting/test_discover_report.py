"""The report of a search reads sensibly for every verdict, and its figures say what the tables do."""

import html
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import searches

from simpel_cli.reporting.discover import next_commands, publish
from simpel_cli.reporting.discover_sections import equation_section, marked, next_section, prior_section, untested
from simpel_cli.reporting.figures import discover_evidence, discover_force, discover_next, discover_runs, draw_discover
from simpel_cli.reporting.figures.canvas import with_interval
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.files import read_columns, read_units, write_table

KINDS = ("effect", "ambiguous", "none", "unexplained")


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> Any:
    return request.param


def headings(page: str) -> list[str]:
    return [html.unescape(h) for h in re.findall(r"<h2>(.*?)</h2>", page)]


def test_report(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = searches.verdict(kind)
    path = publish(Terminal(False), found, searches.directory(tmp_path, kind), searches.CONFIG)
    page = path.read_text()
    assert "<script" not in page
    assert not re.search(r'(src|href)="(?!data:)', page)  # self-contained
    for wrong in ("None", "nan", "Undefined", "{{", "inf"):
        text = re.sub(r'src="data:[^"]*"', "", page).split("<h2>Configuration")[0]
        assert not re.search(rf"(?<![\w<]){wrong}(?!\w)", text), wrong
    assert page.index(found["summary"]) < page.index("<h2>")  # opens with the sentence
    order = headings(page)
    wanted = {
        "effect": ["Test error before and after", "The equation before and after", "Effects that were added",
                   "Latent force (model error)", "Fitted effects and latent force", "Simulation of a test episode",
                   "Evidence of every candidate"],
        "none": ["Test error of the calibrated simulator", "The equation", "Latent force (model error)",
                 "Simulation of a test episode"],
    }  # fmt: skip
    head = wanted["effect" if found["effects"] else "none"]
    assert order[: len(head)] == head
    tail = ["Effects that were not found, and their largest possible size", "Range of the training data", "Data checks"]
    tail += ["Next experiment"] if kind == "ambiguous" else []
    assert order[-len(tail) - 2 :] == [*tail, "Next commands", "Configuration"]
    assert ("Unexplained model error" in order) == (kind == "unexplained")
    assert ("viscous friction" in page) == (kind == "ambiguous")
    printed = capsys.readouterr().out
    assert str(path) in printed
    assert ("10.0x (9.0..11.0)" in printed) == bool(found["effects"])
    assert "omega outside -2..2.5 rad/s" in printed
    assert (searches.NEXT["description"] in printed) == (kind == "ambiguous")


def test_without_a_report_the_verdict_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = searches.directory(tmp_path, "effect")
    path = publish(Terminal(False), searches.verdict("effect"), folder, searches.CONFIG | {"report": False})
    assert path == folder / "verdict.json"
    assert str(path) in capsys.readouterr().out
    assert not list(folder.glob("*.html")) + list(folder.glob("*.png"))


def test_a_fit_that_was_stopped_early_has_no_size(tmp_path: Path) -> None:
    """The spread of a fit that never came to rest says nothing about the size of its effect."""
    page = publish(Terminal(True), searches.verdict("none"), searches.directory(tmp_path, "none"), searches.CONFIG)
    text = page.read_text()
    assert "0.021 1/rad" in text
    assert "1e-06" not in text
    assert "their size is not known: end stop on omega" in text


def test_new_terms_are_marked() -> None:
    assert marked("u - k*omega", "u - k*omega + (-c)") == [("u - k*omega", False), (" + (-c)", True)]
    pieces = marked("K*u - k*v", "K*(where(abs(u) > d, u, 0)) - k*v")
    assert "".join(text for text, _ in pieces) == "K*(where(abs(u) > d, u, 0)) - k*v"
    assert "where" in "".join(text for text, new in pieces if new)
    assert pieces[0] == ("K*", False)


def test_what_no_yaml_can_state_is_said() -> None:
    found = searches.verdict("effect") | {"corrected_sim_lacks": ["sensor_bias on omega"]}
    section = equation_section(found, searches.SIM, searches.CORRECTED)
    assert "sensor bias on omega" in section["after"]
    assert equation_section(found, {"_target_": "my.Simulator", "name": "rig"}, None) == {}  # not in symbols of a YAML


def test_a_late_input_is_part_of_the_equation() -> None:
    late = searches.CORRECTED | {"inputs": {"u": searches.SIM["inputs"]["u"] | {"delay": "d"}}}
    blocks = equation_section(searches.verdict("effect"), searches.SIM, late)["equations"]
    assert len(blocks[0]["lines"]) == 1
    assert blocks[1]["lines"][-1] == [("u acts as u(t - d)", True)]
    known = equation_section(searches.verdict("effect"), late, late)["equations"]
    assert known[1]["lines"][-1] == [("u acts as u(t - d)", False)]


def test_next_experiment(tmp_path: Path) -> None:
    assert next_section({"next_experiment": None}) == {}
    section = next_section({"next_experiment": searches.NEXT})
    assert section["note"] == searches.NEXT["description"]
    assert section["rows"][0] == ["coulomb friction", "viscous friction", "13.7 nat"]
    nothing = searches.NEXT | {"file": None, "pairs": [], "description": "None was found."}
    assert next_section({"next_experiment": nothing})["note"] == "None was found."
    path = searches.directory(tmp_path, "ambiguous") / "next_experiment.csv"
    top, below = discover_next.draw_next(searches.verdict("ambiguous"), path).axes
    assert top.get_ylabel() == "u [V]"
    assert [line.get_label() for line in below.lines] == ["if coulomb friction", "if viscous friction"]
    np.testing.assert_allclose(below.lines[1].get_ydata()[:2], np.sin([-0.4, -0.35]))


def test_commands_fit_the_verdict() -> None:
    def lines(kind: str) -> list[str]:
        return next_commands(searches.verdict(kind), Path("run"), searches.CONFIG)

    assert lines("effect")[0] == "simpel fit --config-dir run/conf sim=rotor_with_coulomb_friction data=bench"
    assert lines("none") == ["simpel fit experiment=rotor          # with the declared simulator"]
    assert any("effect=[all,my_effect]" in line for line in lines("unexplained"))


def test_untested() -> None:
    columns = {
        "quantity": np.array(["phi", "v", "u"]), "unit": np.array(["rad", "m/s", "1"]), "low": np.array([-1.0, -0.5, -2.0]),
        "high": np.array([1.0, 1.9, 1.95]), "range_low": np.array([-3.1, -3.0, -2.0]),
        "range_high": np.array([3.1, 3.0, 2.0]), "periodic": np.array([True, False, False]),
    }  # fmt: skip
    assert untested(columns) == ["v outside -0.5..1.9 m/s"]


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ((1.30166, 1.2983, 1.30502), "1.3017 (1.2983..1.3050)"),
        ((0.853, 0.681, 1.026), "0.85 (0.68..1.03)"),
        ((31.2, 24.9, 38.1), "31.2 (24.9..38.1)"),
        ((327.0, 272.0, 386.0), "327 (272..386)"),
        ((3.1e-9, 2e-9, 4e-9), "3.1e-09 (2e-09..4e-09)"),
        ((2.0, 2.0, 2.0), "2 (2..2)"),
        ((0.5,), "0.5"),
        ((float("nan"),), "-"),
    ],
)
def test_numbers_have_the_digits_that_their_interval_allows(numbers: tuple[float, ...], text: str) -> None:
    assert with_interval(*numbers) == text


def test_units_of_columns_come_back(tmp_path: Path) -> None:
    write_table(tmp_path / "t.parquet", {"time": [0.0], "n": [1]}, {"time": "s", "absent": "m"})
    assert read_units(tmp_path / "t.parquet") == {"time": "s"}
    assert pq.read_table(tmp_path / "t.parquet").to_pydict() == {"time": [0.0], "n": [1]}


def test_figures(tmp_path: Path, kind: str) -> None:
    names = [path.stem for path in draw_discover(searches.directory(tmp_path, kind))]
    wanted = ["residual", "effects", "traces", "evidence", "parameters", "whiteness", "errors"]
    wanted += ["next_experiment"] if kind == "ambiguous" else []
    assert names == (wanted if kind in ("effect", "ambiguous") else [n for n in wanted if n != "effects"])


def test_an_error_without_an_interval_is_drawn_without_one(tmp_path: Path) -> None:
    searches.directory(tmp_path, "effect")
    table = pd.read_parquet(tmp_path / "errors.parquet")
    table.loc[table.horizon == "free_run", ["before_low", "before_high"]] = np.nan
    table.to_parquet(tmp_path / "errors.parquet")
    figure = discover_runs.draw_errors(searches.verdict("effect"), tmp_path / "errors.parquet")
    per_output = len(table) // table.output.nunique()
    for axis, output in zip(figure.axes, table.output.unique(), strict=False):
        before, after = (container.lines[2][0].get_segments() for container in axis.containers)
        assert (len(before), len(after)) == (per_output - 1, per_output), output
        points = [line for line in axis.lines if line.get_label() == "calibrated simulator"]
        assert [len(line.get_xdata()) for line in points] == [per_output]


def test_the_curve_runs_through_the_points(tmp_path: Path) -> None:
    """The fitted curve of the figure lies inside the band of what is seen."""
    searches.directory(tmp_path, "effect")
    figure = discover_force.draw_effects(
        searches.verdict("effect"), tmp_path / "residuals.parquet", tmp_path / "effect_curves.parquet"
    )
    axis = figure.axes[0]
    lines = {line.get_label(): line.get_xydata() for line in axis.lines}
    seen, curve = lines["latent force: mean and 95 % band"], lines["fitted effect"]
    away = seen[:, 1] - np.interp(seen[:, 0], curve[:, 0], curve[:, 1])
    assert np.abs(away[np.abs(seen[:, 0]) > 1]).max() < 0.15
    assert axis.get_xlabel() == "omega [rad/s]"
    assert axis.get_ylabel() == "force on omega [rad/s^2]"


def test_evidence_shows_accepted_tied_and_stopped_early(tmp_path: Path) -> None:
    searches.directory(tmp_path, "ambiguous")
    figure = discover_evidence.draw_evidence(searches.verdict("ambiguous"), tmp_path / "candidates.parquet")
    first = figure.axes[0]
    assert first.get_title(loc="left") == "step 1: + coulomb friction on omega"
    labels = [t.get_text() for t in first.get_yticklabels()]
    assert labels[:3] == [
        "coulomb friction on omega",
        "stribeck friction on omega",
        "unknown function of omega on omega",
    ]
    widths = [bar.get_width() for bar in first.patches]
    assert max(widths) == 1738.0
    assert min(widths) == discover_evidence.LOWEST  # of -96595 nats
    texts = " ".join(t.get_text() for t in first.texts)
    assert "tie:" in texts
    assert "1 of them diverged" in texts
    assert figure.axes[1].get_title(loc="left") == "step 2: no further effect is accepted"
    assert "tie:" not in " ".join(t.get_text() for t in figure.axes[1].texts)


def test_an_effect_that_was_given_up_later_is_said_to_be_that(tmp_path: Path) -> None:
    searches.directory(tmp_path, "ambiguous")
    found = searches.verdict("ambiguous") | {"effects": []}
    figure = discover_evidence.draw_evidence(found, tmp_path / "candidates.parquet")
    assert figure.axes[0].get_title(loc="left") == "step 1: + coulomb friction on omega (given up later)"


def test_a_step_at_which_several_effects_were_taken_at_once_does_not_say_that_none_was(tmp_path: Path) -> None:
    searches.directory(tmp_path, "ambiguous")
    path = tmp_path / "candidates.parquet"
    pd.read_parquet(path).assign(accepted=False).to_parquet(path)
    figure = discover_evidence.draw_evidence(searches.verdict("ambiguous"), path)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles == ["step 1: several effects together are worth more", "step 2: no further effect is accepted"]


def test_the_typical_episode_is_shown(tmp_path: Path) -> None:
    searches.directory(tmp_path, "effect")
    assert discover_runs.typical_episode(read_columns(tmp_path / "trajectories.parquet")) == "c"


def test_bins_average_and_say_how_surely() -> None:
    x = np.repeat([0.0, 1.0, 2.0], 50)
    y = x**2 + np.tile([-1.0, 1.0], 75)
    found = discover_force.binned(x, y, bins=3)
    np.testing.assert_allclose(found.at, [0, 1, 2])
    np.testing.assert_allclose(found.mean, [0, 1, 4])
    np.testing.assert_allclose(found.error, np.sqrt(50 / 49) / np.sqrt(50))
    assert len(discover_force.binned(np.array([np.nan]), np.ones(1)).at) == 0


def test_priors_are_compared_size_by_size() -> None:
    fits = {
        "before": {"20": {"nll": [-9.07, -9.15, -8.93], "free_run_rmse@1s phi": [0.08, 0.07, 0.14]}},
        "after": {"20": {"nll": [-9.26, -9.30, -9.09], "free_run_rmse@1s phi": [0.05, 0.04, 0.06]}},
    }
    section = prior_section({"as_prior": fits})
    assert [row[:2] for row in section["rows"]] == [["20 transitions", "NLL"], ["20 transitions", "RMSE after 1s phi"]]
    assert "-9.07" in section["rows"][0][2]
    assert "-9.26" in section["rows"][0][3]
    assert prior_section({}) == {}


def test_equations_in_python_show_what_was_added() -> None:
    before = {"_target_": "simulators.racecar.RaceCar", "name": "racecar", "inputs": {"steer": {"delay": "T"}}}
    after = {
        "_target_": "simulators.extended.Extended", "name": "more", "base": before,
        "inputs": {"throttle": {"value": "a*throttle"}}, "dynamics": {"omega": "(-c*omega)"},
    }  # fmt: skip
    old, new = equation_section(searches.verdict("effect"), before, after)["equations"]
    assert [[text for text, _ in line] for line in old["lines"]] == [
        ["d(omega)/dt = [as in racecar]"],
        ["steer acts as steer(t - T)"],
    ]
    lines = ["".join(text for text, _ in line) for line in new["lines"]]
    assert lines == [
        "d(omega)/dt = [as in racecar] + (-c*omega)",
        "steer acts as steer(t - T)",
        "throttle acts as a*throttle",
    ]
    assert [new["lines"][k][0][1] for k in (1, 2)] == [False, True]  # the delay was there before


def test_of_a_long_course_the_last_swings_are_shown() -> None:
    time = np.arange(5000) / 10
    fast, slow = np.sin(2 * np.pi * time), np.sin(2 * np.pi * time / 100)
    begin = discover_runs.last_swings(fast)
    assert np.sum(np.diff(np.sign(fast[begin:])) != 0) == pytest.approx(discover_runs.MOST_SWINGS, abs=1)
    noisy = slow + 0.1 * np.random.default_rng(0).normal(size=len(time))
    assert discover_runs.last_swings(noisy) == 0
    assert discover_runs.last_swings(np.full(9, np.nan)) == discover_runs.last_swings(np.ones(9)) == 0
