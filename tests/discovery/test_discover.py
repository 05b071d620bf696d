"""`simpel discover` as a user runs it; the truth is read from files that the command cannot reach."""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import yaml
from command_line import process

TRUTH = Path(__file__).parents[1] / "exam" / "truth"
FEW = "effect=[viscous_friction,coulomb_friction,input_delay]"
QUICK = (
    "method.steps=100",
    "method.particles=4",
    "method.network.hidden=[16,16]",
    "method.pool=64",
    "method.sets=16",
    "prior.draws=64",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("discover")
    result = process(folder, "discover", "experiment=hidden_pendulum", FEW, *QUICK, "hydra.run.dir=run", "--strict")
    assert result.code == 0, result.err
    (folder / "out.txt").write_text(result.out)
    return folder


def verdict(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "run" / "verdict.json").read_text())


def test_names_the_hidden_effect_with_its_size(run: Path) -> None:
    (planted,) = json.loads((TRUTH / "hidden_pendulum.json").read_text())["effects"]
    found = verdict(run)
    assert found["verdict"] == "effect"
    (effect,) = found["effects"]
    assert (effect["name"], effect["acts_on"]) == (planted["name"], planted["acts_on"])
    size, true = effect["parameters"]["tau_c"], planted["parameters"]["tau_c"]
    assert size["unit"] == true["unit"]
    assert abs(size["value"] - true["value"]) < 0.03 * true["value"]
    assert effect["held_out_gain"]["low"] > 0


def test_the_error_falls_to_the_noise(run: Path) -> None:
    found = verdict(run)
    before, after = (found["error"][key]["horizon"] for key in ("before", "after"))
    for name, floor in found["noise_floor"].items():
        assert after[name] < 1.5 * floor < before[name]
        low, high = found["error"]["ci95_of_reduction"][name]
        assert low < before[name] / after[name] < high


def test_says_what_was_not_found_and_how_small_it_must_be(run: Path) -> None:
    smallest = {entry["name"]: entry["smallest_detectable"] for entry in verdict(run)["not_found"]}
    assert 0 < smallest["viscous_friction"] < 0.2
    assert 0 < smallest["input_delay"] < 0.02


def test_one_screen_ends_with_the_next_command(run: Path) -> None:
    lines = (run / "out.txt").read_text().splitlines()
    assert len(lines) < 40
    assert any(line.startswith("next") and "sim=pendulum_with_coulomb_friction" in line for line in lines)


def test_every_candidate_is_on_record(run: Path) -> None:
    rows = pq.read_table(run / "run" / "candidates.parquet").to_pylist()
    assert {r["effect"] for r in rows} == {"viscous_friction", "coulomb_friction", "input_delay", "unnamed"}
    assert [r["effect"] for r in rows if r["accepted"]] == ["coulomb_friction"]


def test_both_simulators_are_compared_as_priors(run: Path) -> None:
    found = verdict(run)["as_prior"]
    assert set(found) == {"before", "after"}
    for by_size in found.values():
        assert set(by_size) == {"20", "50"}
        for metrics in by_size.values():
            assert {"nll", "nrmse", "free_run_rmse@1s phi"} <= set(metrics)
            assert all(low <= median <= high for median, low, high in metrics.values())
    rows = pq.read_table(run / "run" / "metrics.parquet").to_pylist()
    assert {r["sim"] for r in rows} == {"pendulum", "pendulum_with_coulomb_friction"}
    assert {(r["command"], r["n_train"]) for r in rows} == {("discover", 20), ("discover", 50)}
    assert {r["seed"] for r in rows} == set(range(5))


def test_fit_reads_the_corrected_simulator(run: Path) -> None:
    path = run / "run" / verdict(run)["corrected_sim"]
    node = yaml.safe_load(path.read_text())
    assert "tau_c" in node["parameters"]
    words = ("--config-dir", run / "run" / "conf", f"sim={path.stem}", "data=hidden_pendulum", "data.n_train=20")
    result = process(run, "fit", *words, "method.steps=20", "method.particles=3", "hydra.run.dir=fitted")
    assert result.code == 0, result.err
    used = yaml.safe_load((run / "run" / "conf" / "data" / "hidden_pendulum.yaml").read_text())
    assert Path(used["path"]).is_absolute()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("experiment=pendulum_black_box", FEW), 2, "sim: discover needs a simulator in symbols"),
        (("experiment=hidden_pendulum", "effect=[]"), 2, "effect: none chosen; use effect=[all]"),
        (("experiment=hidden_pendulum", "effect=[friction]"), 2, "effect: no option 'friction'"),
        (("experiment=hidden_pendulum", FEW, "discovery.horizont=3"), 2, "Did you mean discovery.horizon?"),
        (("experiment=hidden_pendulum", FEW, "effect.viscous_friction.acts_on=[speed]"), 2, "'speed' is no role"),
        (("experiment=hidden_pendulum", FEW, "data.columns={omega: speed}"), 3, "column 'speed' is missing"),
    ],
)
def test_wrong_words(tmp_path: Path, words: tuple[str, ...], code: int, message: str) -> None:
    result = process(tmp_path, "discover", *words)
    assert "Traceback" not in result.err
    assert message in result.err
    assert result.code == code


def test_the_report_has_every_figure_and_opens_with_the_sentence(run: Path) -> None:
    page = (run / "run" / "report.html").read_text()
    assert page.index(verdict(run)["summary"].split(" (")[0]) < page.index("<h2>")
    figures = {path.stem for path in (run / "run").glob("*.png")}
    assert figures == {"residual", "effects", "traces", "evidence", "parameters", "whiteness", "errors"}
    assert page.count("data:image/png;base64,") == len(figures)
    assert "report.html" in (run / "out.txt").read_text()


def test_the_latent_force_shows_the_planted_friction(run: Path) -> None:
    """With the effect switched off, what is left steps by twice the friction where the speed changes its sign."""
    (planted,) = json.loads((TRUTH / "hidden_pendulum.json").read_text())["effects"]
    rows = pq.read_table(run / "run" / "residuals.parquet").to_pylist()
    without = [r for r in rows if r["model"] == "without" and abs(r["omega"]) > 0.3]
    left, right = ([r["force"] for r in without if (r["omega"] > 0) == side] for side in (False, True))
    step = sum(left) / len(left) - sum(right) / len(right)
    assert abs(step - 2 * planted["parameters"]["tau_c"]["value"]) < 0.2 * step
