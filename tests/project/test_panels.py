"""The scripts that reproduce the paper's panels: what is paired, what is claimed, which fits there are."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.reproduce import panel_a, panel_b
from tests.reproduce.panel import WORDS, Cell, Fit, Table, advantage, best_of, draw, judged, markdown, scales, verdict
from tests.reproduce.panel import _done as done

NAN = float("nan")


def table(**values: list[list[float]]) -> Table:
    return {("s", method, 10): Cell(np.array(v, float)) for method, v in values.items()}


def test_advantage_pairs_seed_with_seed() -> None:
    """Differences 1, 1, 1 of data seeds that lie far apart: no doubt; a seed that only one of them has does not count."""
    both = table(a=[[1.0], [5.0], [9.0], [NAN]], b=[[2.0], [6.0], [10.0], [50.0]])
    gain, half = advantage(both, "s", "a", "b", 10)
    assert gain == pytest.approx(1.0)
    assert half == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(advantage(both, "s", "a", "c", 10)[0])


def test_interval_of_an_advantage_is_students() -> None:
    """Differences 0, 1, 2: mean 1, t(2) = 4.303 times 1/sqrt(3)."""
    gain, half = advantage(table(a=[[0.0], [0.0], [0.0]], b=[[0.0], [1.0], [2.0]]), "s", "a", "b", 10)
    assert gain == pytest.approx(1.0)
    assert half == pytest.approx(4.302653 / np.sqrt(3), rel=1e-5)


def test_spread_is_over_model_seeds_of_the_mean_over_data_seeds() -> None:
    assert Cell(np.array([[1.0, 3.0], [3.0, 7.0]])).spread == pytest.approx(np.std([2.0, 5.0], ddof=1))
    assert Cell(np.array([[1.0], [3.0], [NAN]])).spread == pytest.approx(np.std([1.0, 3.0], ddof=1))


def test_best_is_the_lowest_of_those_that_are_there() -> None:
    some = table(a=[[1.0]], b=[[0.5]])
    assert best_of(some, "s", ["a", "b", "c"], 10) == "b"
    assert best_of(some, "s", ["c"], 10) is None


def test_errors_of_two_simulators_are_told_on_one_scale() -> None:
    rows = [
        {"metric": m, "output": o, "seed": 0, "value": v}
        for m, o, v in (
            ("rmse", "x", 2.0),
            ("nrmse", "x", 0.5),
            ("rmse", "y", 3.0),
            ("nrmse", "y", 0.3),
            ("nll", "joint", -1.0),
            ("nll", "x", -2.0),
            ("nll", "y", 0.5),
        )
    ]
    assert scales(rows) == pytest.approx({"x": 4.0, "y": 10.0})
    assert judged(rows, {"x": 4.0, "y": 10.0}) == [
        (0, "nll", -1.0),
        (0, "nll_sum", -1.5),
        (0, "nrmse", pytest.approx(np.sqrt((0.25 + 0.09) / 2))),
    ]


@pytest.mark.parametrize("system", ["pendulum", "racecar"])
def test_claims_of_panel_a(system: str) -> None:
    """SimPEL ahead by 1 nat where data are few, behind by 1 where they are many; alone as good, or worse by 2."""

    def one(simpel: float, alone: float) -> Table:
        found: Table = {}
        for n, other in ((10, 1.0), (40, 1.0), (160, -1.0)):
            for method, value in (
                ("simpel", simpel),
                ("simpel_only_sim", alone),
                ("fsvgd", simpel + other),
                ("gp", 0.0),
                ("pathwise", simpel + other + 0.5),
            ):
                found[system, method, n] = Cell(np.array([[value, value + 0.01], [value, value + 0.01]]))
        return found

    words = [line.split(":")[0] for line in panel_a.claims(one(-5.0, -5.0), [system])]
    assert words[:3] == ["* holds", "* DOES NOT HOLD", "* DOES NOT HOLD" if system == "pendulum" else "* holds"]
    words = [line.split(":")[0] for line in panel_a.claims(one(-5.0, -3.0), [system])]
    assert words[2] == ("* holds" if system == "pendulum" else "* DOES NOT HOLD")
    # half a nat behind FSVGD everywhere
    assert words[3:5] == ["* DOES NOT HOLD", "* DOES NOT HOLD"]
    assert [w.split(",")[1].split()[0] for w in words[5:]] == ["simpel", "pathwise"]  # against the exact GP
    partly = {
        key: cell for key, cell in one(-5.0, -5.0).items() if key[1] not in ("simpel_only_sim", "gp") and key[2] != 160
    }
    assert panel_a.claims(partly, [system])[2].startswith("* not judged")


def test_claims_of_panel_b() -> None:
    found: Table = {}
    for n in (50, 400):
        for method, value in (
            ("simpel", -5.0), ("simpel_only_sim", -5.0), ("simpel_high_fidelity", -6.0), ("fsvgd", 1.0),
            ("sysid_high_fidelity", -5.5),
        ):  # fmt: skip
            found["rc_car", method, n] = Cell(np.array([[value], [value + 0.01]]))
    errors = {key: Cell(cell.values + 10) for key, cell in found.items()}
    words = [line.split(":")[0] for line in panel_b.claims(found, errors)]
    assert words == ["* DOES NOT HOLD", "* DOES NOT HOLD", "* holds", "* holds", "* holds", "* holds"]
    assert verdict("it", None, "why") == "* not judged: it (why)"


def test_fits_of_panel_b_compare_under_the_same_data_and_steps() -> None:
    fits = panel_b.fits(list(panel_b.METHODS), 2, 1, small=True, share=0.3)
    assert len({fit.name for fit in fits}) == len(fits) == len(panel_b.METHODS) * len(panel_b.SMALL) * 2
    for fit in fits:
        assert f"data.seed={fit.data_seed}" in fit.words
        assert f"data.n_train={fit.n_train}" in fit.words
    steps = {w for fit in fits for w in fit.words if ".steps=" in w}
    assert steps == {"method.steps=1500", "method.residual.steps=1500"}


def test_figure_and_table(tmp_path: Path) -> None:
    found = table(simpel=[[-5.0, -5.1]], fsvgd=[[30.0, 31.0]], svgd=[[-4.0, -4.2]])
    draw(tmp_path / "p.png", [("s", "nll", found), ("s", "nrmse", {k: Cell(abs(c.values)) for k, c in found.items()})],
         {"nll": "NLL", "nrmse": "RMSE"}, columns=2)  # fmt: skip
    assert (tmp_path / "p.png").stat().st_size > 5000
    lines = markdown(found, ["s"])
    assert "| simpel | **-5.05 ± 0.071** |" in lines
    assert "| fsvgd | 30.5 ± 0.71 |" in lines


def test_a_fit_of_other_words_is_another_fit(tmp_path: Path) -> None:
    fit = Fit("s", "simpel", 10, 0, ("method=simpel", "method.steps=5"))
    where = tmp_path / fit.name
    where.mkdir()
    (where / "manifest.json").write_text('{"status": "done", "command": "fit"}')
    assert not done(fit, tmp_path)
    (where / WORDS).write_text("method=simpel\nmethod.steps=5\n")
    assert done(fit, tmp_path)
    assert not done(fit._replace(words=("method=simpel", "method.steps=6")), tmp_path)


@pytest.mark.parametrize("panel", [panel_a, panel_b])
def test_what_a_panel_can_be_asked_for(panel: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["panel", "--help"])
    with pytest.raises(SystemExit, match="0"):
        panel.main()
