"""The verbs from end to end, with tiny settings: files of the contract, repeatability, evaluation, simulation, words."""

import errno
import json
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from command_line import FIT, ROOT, TINY, csv, environment, rig, rows, simpel, swing
from safetensors.numpy import load_file

from simpel_cli.runs.manifest import sha256

VERBS = [
    "fit", "evaluate", "discover", "rl-offline", "rl-online", "sweep", "report", "export", "import", "sims", "effects",
    "example", "doctor", "simulate", "schema",
]  # fmt: skip
SCHEMA = [
    ("run", pa.string()), ("command", pa.string()), ("experiment", pa.string()), ("method", pa.string()),
    ("sim", pa.string()), ("data", pa.string()), ("n_train", pa.int32()), ("seed", pa.int32()), ("step", pa.int64()),
    ("split", pa.string()), ("metric", pa.string()), ("output", pa.string()), ("unit", pa.string()),
    ("value", pa.float64()),
]  # fmt: skip


def run(cwd: Path, *words: object) -> str:
    result = simpel(cwd, *words)
    assert result.code == 0, result.err
    return result.out


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a fit."""
    folder = tmp_path_factory.mktemp("fitted")
    run(folder, *FIT, "hydra.run.dir=fit", "evaluation.horizon=0.5", "run.figures=true")
    return folder / "fit"


class TestFit:
    def test_files(self, fitted: Path) -> None:
        names = {str(p.relative_to(fitted)) for p in fitted.rglob("*") if p.is_file()}
        expected = {
            "manifest.json", "config.yaml", "metrics.parquet", "predictions.parquet", "calibration.parquet",
            "horizon.parquet", "trajectories.parquet", "prior_predictive.parquet", "checkpoint/state.safetensors", "run.log",
            "report.html", ".lock",
            ".hydra/config.yaml", ".hydra/overrides.yaml", ".hydra/hydra.yaml",
        }  # fmt: skip
        assert expected <= names
        figures = {n for n in names if n.endswith(".png")}
        assert {
            "learning_curves.png",
            "predictions.png",
            "calibration.png",
            "free_run.png",
            "free_run_example.png",
        } <= figures
        assert names == expected | figures  # and nothing temporary

    def test_manifest(self, fitted: Path) -> None:
        record = json.loads((fitted / "manifest.json").read_text())
        assert record["status"] == "done"
        assert record["error"] is None
        assert record["command"] == "fit"
        assert "experiment=pendulum" in record["command_line"]
        assert record["seed"] == 0
        assert record["n_train"] == 20
        assert record["wall_seconds"] > 0
        assert {"device", "python", "platform", "finished", "git_commit"} <= record.keys()
        assert {"jax", "hydra-core", "casadi", "numpy", "simpel"} <= record["versions"].keys()
        assert record["versions"]["jax"]
        for path, digest in record["inputs_sha256"].items():
            assert sha256(Path(path)) == digest
        assert any(p.endswith("measurements.parquet") for p in record["inputs_sha256"])

    def test_schema(self, fitted: Path) -> None:
        schema = pq.read_schema(fitted / "metrics.parquet")
        assert list(zip(schema.names, schema.types, strict=True)) == SCHEMA

    def test_constants_and_metrics(self, fitted: Path) -> None:
        table = pq.read_table(fitted / "metrics.parquet").to_pylist()
        for name, value in [
            ("run", "fit"), ("command", "fit"), ("experiment", "pendulum"), ("method", "simpel"), ("sim", "pendulum"),
            ("data", "pendulum"), ("n_train", 20), ("seed", 0),
        ]:  # fmt: skip
            assert {row[name] for row in table} == {value}
        train = [row for row in table if row["split"] == "train"]
        assert {row["step"] for row in train} == {50, 100}
        assert {row["metric"] for row in train} == {"loss", "mean_kernel", "noise_std"}
        test = [row for row in table if row["split"] == "test"]
        assert {row["step"] for row in test} == {100}
        for metric in ("nll", "rmse", "nrmse", "mae", "crps", "coverage_90", "calibration_error"):
            of = [row["output"] for row in test if row["metric"] == metric]
            assert of == ["sin(phi)", "cos(phi)", "omega", "joint"]
            assert {row["output"] for row in test if row["metric"] == f"{metric}_low"} == set(of)
        assert {row["unit"] for row in test if row["metric"] == "rmse" and row["output"] == "omega"} == {"rad/s"}

    def test_predictions_carry_the_users_episodes_and_times(self, fitted: Path) -> None:
        found = pq.read_table(fitted / "predictions.parquet").to_pylist()
        data = pq.read_table(ROOT / "data" / "pendulum" / "measurements.parquet").to_pylist()
        speed = {(str(row["episode"]), round(row["t"], 6)): row["omega"] for row in data if row["split"] == "test"}
        assert {row["episode"] for row in found} == {episode for episode, _ in speed}
        assert {row["segment"] for row in found} == {1}
        for row in found:
            if row["output"] == "omega":
                now, then = (speed[row["episode"], round(row["time"] + dt, 6)] for dt in (0.0, 0.05))
                assert row["measured"] == pytest.approx(then - now, abs=1e-9)

    def test_free_runs_along_the_measurements(self, fitted: Path) -> None:
        found = pq.read_table(fitted / "trajectories.parquet").to_pylist()
        data = pq.read_table(ROOT / "data" / "pendulum" / "measurements.parquet").to_pylist()
        speed = {(str(row["episode"]), round(row["t"], 6)): row["omega"] for row in data}
        assert {(row["output"], row["unit"]) for row in found} == {("phi", "rad"), ("omega", "rad/s")}
        for row in found:
            assert -1e-9 < row["time"] - row["start"] < 0.5 + 1e-9
            assert row["std"] > 0
            if row["output"] == "omega":
                assert row["measured"] == pytest.approx(speed[row["episode"], round(row["time"], 6)], abs=1e-9)
            else:
                assert abs(row["mean"] - row["measured"]) < np.pi  # on the same turn
            if row["time"] == row["start"]:
                assert row["mean"] == pytest.approx(row["measured"], abs=1e-6)

    def test_a_joint_error_of_mixed_units_is_kept_but_not_shown(self, fitted: Path) -> None:
        joint = {row["metric"]: row for row in rows(fitted, split="test") if row["output"] == "joint"}
        assert joint["rmse"]["unit"] == "mixed"  # rad/s, and none for sine and cosine
        said = (fitted / "run.log").read_text()
        (line,) = re.findall(r"^ +joint .*", said, re.M)
        cells = re.split(r" {2,}", line.strip())
        assert [cells[i] for i in (2, 4, 5)] == ["-"] * 3
        assert cells[3].startswith(f"{joint['nrmse']['value']:.3g} (")
        assert re.search(r"test \(3 episodes\) +NLL \S+ \(\S+\)   normalised RMSE \S+ \(\S+\)   coverage", said)

    def test_config_is_resolved_and_builds_again(self, fitted: Path) -> None:
        text = (fitted / "config.yaml").read_text()
        assert "${" not in text
        config = yaml.safe_load(text)
        assert config["method"]["steps"] == 100
        assert config["choices"]["method"] == "simpel"
        assert Path(config["data"]["path"]).is_absolute()

    def test_checkpoint(self, fitted: Path) -> None:
        arrays = load_file(fitted / "checkpoint" / "state.safetensors")
        assert arrays
        assert all(a.dtype == "float32" or a.dtype.kind == "i" for a in arrays.values())

    def test_report_is_self_contained(self, fitted: Path) -> None:
        page = (fitted / "report.html").read_text()
        assert len(re.findall(r'src="data:image/png;base64,', page)) >= 4
        assert not re.search(r"(?:src|href)=\"(?!data:)", page)
        assert not re.search(r"https?://|@import|url\(", page)
        assert "<script" not in page
        assert "simpel evaluate" in page

    def test_report_says_how_the_result_came_about(self, fitted: Path) -> None:
        record = json.loads((fitted / "manifest.json").read_text())
        page = (fitted / "report.html").read_text()
        table = page[page.index("<h2>Run</h2>") : page.index("<h2>Data checks</h2>")]
        cells = re.findall(r"<td[^>]*>(.*?)</td>", table)
        run_table = dict(zip(cells[::2], cells[1::2], strict=True))
        assert run_table["training"] == "20 of 531 transitions"
        assert run_table["seeds"] == "0"
        said = re.search(r"kappa ([\d.e -]+)", (fitted / "run.log").read_text())
        kappa = re.findall(r"(?:sin\(phi\)|cos\(phi\)|omega) ([\d.e-]+)", run_table["gap scale kappa"])
        assert said is not None
        assert [f"{float(k):.2g}" for k in kappa] == said[1].split()
        # a free run starts from a measured state: no spread there but that of the noise
        start = next(
            row for row in pq.read_table(fitted / "trajectories.parquet").to_pylist()
            if row["output"] == "omega" and row["time"] == row["start"]
        )  # fmt: skip
        assert f"omega {start['std']:.3g} rad/s" in run_table["learned noise"]
        assert run_table["device"] == f"{record['device']}, float32"
        assert f"training {record['train_seconds']:.1f} s" in run_table["time"]
        seconds = re.search(r"([\d.]+) s in total", run_table["time"])
        assert seconds is not None
        assert record["train_seconds"] < float(seconds[1]) <= record["wall_seconds"] + 0.05
        for name in ("simpel", "jax", "numpy"):
            assert f"{name} {record['versions'][name]}" in run_table["software"]

    def test_same_seed_same_numbers(self, fitted: Path, tmp_path: Path) -> None:
        run(tmp_path, *FIT, "hydra.run.dir=again", "evaluation.horizon=0.5")
        assert rows(tmp_path / "again") == rows(fitted)

    def test_another_seed_other_numbers(self, fitted: Path, tmp_path: Path) -> None:
        run(tmp_path, *FIT, "hydra.run.dir=other", "evaluation.horizon=0.5", "run.seed=1")
        values = [[r["value"] for r in rows(d) if r["metric"] == "nll"] for d in (fitted, tmp_path / "other")]
        assert values[0] != values[1]

    def test_seeds_at_once_are_the_seeds_one_by_one(self, fitted: Path, tmp_path: Path) -> None:
        run(tmp_path, *FIT, "hydra.run.dir=both", "evaluation.horizon=0.5", "run.seeds=2")
        both = rows(tmp_path / "both")
        assert {row["seed"] for row in both} == {0, 1}
        alone = {(r["split"], r["metric"], r["output"], r["step"]): r["value"] for r in rows(fitted)}
        ours = {(r["split"], r["metric"], r["output"], r["step"]): r["value"] for r in both if r["seed"] == 0}
        assert ours.keys() == alone.keys()
        # one program trains them side by side; sums are taken in another order, so not to the last bit
        for key in [k for k in alone if k[1] in ("loss", "rmse", "noise_std")]:
            assert ours[key] == pytest.approx(alone[key], rel=0.05)
        assert load_file(tmp_path / "both" / "checkpoint" / "state.safetensors")["['state'].noise"].shape[0] == 2

    @pytest.mark.slow
    def test_float64(self, tmp_path: Path) -> None:
        run(tmp_path, *FIT, "hydra.run.dir=run", "run.precision=float64")
        arrays = load_file(tmp_path / "run" / "checkpoint" / "state.safetensors")
        assert all(a.dtype == "float64" or a.dtype.kind == "i" for a in arrays.values())

    def test_segments_of_an_episode_are_not_taken_for_episodes(self, tmp_path: Path) -> None:
        """Every sixth row is lost, so that each of four episodes falls into twelve pieces."""
        rig(tmp_path, measurements=csv([r for i, r in enumerate(swing(episodes=4, rows=72)) if i % 6 != 5]))
        run(tmp_path, "fit", "--config-dir", "my", "sim=cart", "data=rig", *TINY, "hydra.run.dir=run")
        said = (tmp_path / "run" / "run.log").read_text()
        assert "3 train / 1 test episodes in 36 / 12 segments," in said
        assert "test (1 episode in 12 segments)" in said
        assert "resampling 4 windows of 1 s)" in said
        found = pq.read_table(tmp_path / "run" / "predictions.parquet").to_pylist()
        assert len({row["episode"] for row in found}) == 1
        assert {row["segment"] for row in found} == set(range(1, 13))
        assert all(row["time"] == pytest.approx(0.05 * (6 * (row["segment"] - 1) + row["row"])) for row in found)


class TestEvaluate:
    def test_repeats_the_judgement_of_the_fit(self, fitted: Path) -> None:
        run(fitted.parent, "evaluate", fitted, "hydra.run.dir=evaluated", "run.quiet=true")
        again = fitted.parent / "evaluated"
        assert rows(again, "command") == rows(fitted, "command", split="test")
        assert {row["command"] for row in rows(again)} == {"evaluate"}
        assert json.loads((again / "manifest.json").read_text())["status"] == "done"
        assert (again / "report.html").exists()

    def test_another_horizon(self, fitted: Path, tmp_path: Path) -> None:
        run(tmp_path, "evaluate", fitted, "hydra.run.dir=e", "evaluation.horizon=0.25", "run.quiet=true")
        horizons = {r["metric"] for r in rows(tmp_path / "e") if str(r["metric"]).startswith("free_run_rmse@")}
        assert any("0.25" in str(h) for h in horizons)
        assert not any("0.5" in str(h) for h in horizons)

    def test_other_measurements(self, fitted: Path, tmp_path: Path) -> None:
        run(
            tmp_path,
            "simulate",
            "sim=pendulum_high_fidelity",
            "simulation.episodes=4",
            "simulation.steps=30",
            "out=my/made",
        )
        (tmp_path / "my" / "data").mkdir()
        (tmp_path / "my" / "data" / "other.yaml").write_text(
            "path: ../made/measurements.parquet\ntime: t\nepisode: episode\nsplit: {column: split}\n"
        )
        words = ("evaluate", fitted, "--config-dir", "my", "data=other", "hydra.run.dir=e", "run.quiet=true")
        run(tmp_path, *words)
        found = rows(tmp_path / "e")
        assert {row["data"] for row in found} == {"other"}
        assert {row["split"] for row in found} == {"test"}
        nll = [[r["value"] for r in rows(d, split="test") if r["metric"] == "nll"] for d in (fitted, tmp_path / "e")]
        assert nll[0] != nll[1]
        record = json.loads((tmp_path / "e" / "manifest.json").read_text())
        assert any("made" in path for path in record["inputs_sha256"])
        judged = pq.read_table(tmp_path / "e" / "predictions.parquet").to_pylist()
        assert len(judged) == 4 * 29 * 3  # every transition of every episode, whatever the file calls train or test
        assert {row["episode"] for row in judged} == {"0", "1", "2", "3"}
        said = (tmp_path / "e" / "run.log").read_text()
        assert re.search(r"measurements.parquet   all of it, 4 episodes, not used in the fit   checks \d+ ok", said)
        assert "test (4 episodes)" in said
        assert "the fit was not trained on this file" in (tmp_path / "e" / "report.html").read_text()

    def test_one_new_episode(self, fitted: Path, tmp_path: Path) -> None:
        table = pq.read_table(ROOT / "data" / "pendulum" / "measurements.parquet").to_pandas()
        (tmp_path / "my" / "data").mkdir(parents=True)
        table[table["episode"] == 0].drop(columns=["episode", "split"]).to_csv(tmp_path / "my" / "run.csv")
        shutil.copy(ROOT / "data" / "pendulum" / "card.yaml", tmp_path / "my")  # the fit knows this one
        (tmp_path / "my" / "data" / "one.yaml").write_text("path: ../run.csv\ntime: t\n")
        run(tmp_path, "evaluate", fitted, "--config-dir", "my", "data=one", "hydra.run.dir=e", "run.quiet=true")
        judged = pq.read_table(tmp_path / "e" / "predictions.parquet")
        assert judged.num_rows == (len(table) // 12 - 2) * 3  # the one step across the cut is lost
        assert "all of it, 1 episode in 2 segments, not used in the fit" in (tmp_path / "e" / "run.log").read_text()

    def test_the_files_own_training_data_are_not_judged(self, fitted: Path, tmp_path: Path) -> None:
        words = ("data=pendulum", "data.split={test_fraction:0.9,by:episode}", "run.quiet=true")
        run(tmp_path, "evaluate", fitted, *words, "hydra.run.dir=e")
        assert rows(tmp_path / "e", "command") == rows(fitted, "command", split="test")
        said = (tmp_path / "e" / "run.log").read_text()
        assert "measurements.parquet   the test split of the fit, 3 episodes   checks" in said


class TestSimulate:
    def test_what_it_wrote_can_be_fitted(self, tmp_path: Path) -> None:
        words = ("simulation.episodes=4", "simulation.steps=20", "simulation.noise_std.phi=0.01", "out=made")
        run(tmp_path, "simulate", "sim=pendulum", *words)
        table = pq.read_table(tmp_path / "made" / "measurements.parquet")
        assert table.column_names == ["episode", "t", "phi", "omega", "u", "split"]
        assert table.num_rows == 80
        card = yaml.safe_load((tmp_path / "made" / "card.yaml").read_text())
        assert card["columns"]["omega"] == {"unit": "rad/s"}
        assert card["truth"].keys() == {"m", "l", "C_m"}
        run(
            tmp_path,
            "fit",
            "sim=pendulum",
            "data=pendulum",
            "data.path=made/measurements.parquet",
            *TINY,
            "hydra.run.dir=f",
        )
        assert {row["n_train"] for row in rows(tmp_path / "f")} == {57}

    def test_planted_nuisances_of_a_yaml_and_of_the_command_line(self, tmp_path: Path) -> None:
        (tmp_path / "my" / "simulation").mkdir(parents=True)
        (tmp_path / "my" / "simulation" / "rig.yaml").write_text(
            "# a rig\nepisodes: 4\nsteps: 20\nnoise_std: {phi: 0.01 + 0.02*abs(omega)}\n"
            "noise: {phi: {law: student_t, degrees_of_freedom: 3}}\nsaturates: {omega: [null, 1]}\nlatency: {phi: 0.012}\n"
            "clocks: {omega: {offset: 0.003, drift: 1.0e-5}}\nbetween_rows: {u: linear}\nquantisation: {omega: 0.1}\n"
            "groups: {rig: {count: 2, parameters: {l: {law: lognormal, std: 0.2}}}}\n"
            "covariates: {mass_kg: {parameter: m, range: [0.5, 1.5], per: rig}}\n"
        )
        words = ("--config-dir", "my", "sim=pendulum", "simulation=rig", "out=made")
        run(tmp_path, "simulate", *words, "simulation.missing.phi=0.2", "simulation.drift={C_m: 0.1}")
        table = pq.read_table(tmp_path / "made" / "measurements.parquet").to_pydict()
        assert [*table] == ["episode", "t", "rig", "mass_kg", "phi", "omega", "u", "split"]
        assert len(table["t"]) == 4 * (20 + 19)
        assert np.isnan(table["phi"]).sum() > 4 * 19
        card = yaml.safe_load((tmp_path / "made" / "card.yaml").read_text())
        assert card["noise"] == {"phi": {"law": "student_t", "degrees_of_freedom": 3.0}}
        assert card["noise_std"] == {"phi": "0.01 + 0.02*abs(omega)", "omega": 0.0}
        assert card["saturates"] == {"omega": [None, 1.0]}
        assert (card["missing"], card["drift"], card["latency"]) == ({"phi": 0.2}, {"C_m": 0.1}, {"phi": 0.012})
        assert card["truth_by_group"]["rig"].keys() == {"rig_0", "rig_1"}
        assert card["columns"]["mass_kg"] == {"unit": "kg"}

    def test_a_static_function(self, tmp_path: Path) -> None:
        words = ("simulation.episodes=4", "simulation.steps=10", "simulation.noise_std.f=0.1", "out=my/made")
        run(tmp_path, "simulate", "sim=sinusoid", *words)
        (tmp_path / "my" / "data").mkdir()
        (tmp_path / "my" / "data" / "points.yaml").write_text(
            "path: ../made/measurements.parquet\nlayout: transitions\nsplit: {column: split}\n"
        )
        run(tmp_path, "fit", "--config-dir", "my", "sim=sinusoid", "data=points", *TINY, "hydra.run.dir=f")
        found = rows(tmp_path / "f", split="test")
        assert {row["output"] for row in found if row["metric"] == "nll"} == {"f", "joint"}
        assert not [row for row in found if str(row["metric"]).startswith("free_run")]
        assert not (tmp_path / "f" / "horizon.parquet").exists()
        said = (tmp_path / "f" / "run.log").read_text()
        assert "30 train / 10 test rows, 30 rows used " in said
        assert "test (10 rows)" in said
        assert "resampling 10 rows)" in said
        assert re.search(r"  value +NLL", said)
        assert "one step" not in said.lower()
        assert "one step" not in (tmp_path / "f" / "report.html").read_text().split("<h2>Next commands")[0].lower()
        assert set(pq.read_table(tmp_path / "f" / "predictions.parquet")["kind"].to_pylist()) == {"value"}


class TestWords:
    @pytest.mark.parametrize("verb", ["fit", "sweep", "simulate"])
    def test_cfg_prints_and_does_nothing(self, verb: str, tmp_path: Path) -> None:
        result = simpel(tmp_path, verb, "--cfg", "job")
        assert result.code == 0, result.err
        assert "sim" in yaml.safe_load(result.out)
        assert list(tmp_path.iterdir()) == []

    def test_cfg_of_evaluate(self, fitted: Path, tmp_path: Path) -> None:
        result = simpel(tmp_path, "evaluate", fitted, "--cfg", "job")
        assert result.code == 0, result.err
        assert yaml.safe_load(result.out)["run_dir"] == str(fitted)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        "words",
        [
            ("--config-dir", "my", "sim=cart", "data=rig", "--cfg", "job"),
            ("sim=cart", "--config-dir", "my", "--cfg", "job", "data=rig"),
            ("--cfg", "job", "sim=cart", "data=rig", "--config-dir", "my/"),
        ],
    )
    def test_options_may_stand_anywhere(self, words: tuple[str, ...], tmp_path: Path) -> None:
        rig(tmp_path)
        config = yaml.safe_load(run(tmp_path, "fit", *words))
        assert config["sim"]["name"] == "cart"
        assert config["data"]["columns"] == {"s": "pos", "v": "vel", "u": "volts"}

    def test_a_folder_with_conf_inside(self, tmp_path: Path) -> None:
        my = rig(tmp_path)
        my.rename(tmp_path / "conf")
        (tmp_path / "run").mkdir()
        (tmp_path / "conf").rename(tmp_path / "run" / "conf")
        config = yaml.safe_load(run(tmp_path, "fit", "--config-dir", "run", "sim=cart", "--cfg", "job"))
        assert config["sim"]["name"] == "cart"

    def test_two_starts_in_one_second_have_two_directories(self, tmp_path: Path) -> None:
        for _ in range(3):
            run(tmp_path, "simulate", "sim=sinusoid", "simulation.episodes=2", "simulation.steps=2")
        assert len(list(tmp_path.glob("runs/simulate/sinusoid/*"))) == 3

    @pytest.mark.parametrize("words", [(), ("--help",), ("-h",)])
    def test_help(self, words: tuple[str, ...], tmp_path: Path) -> None:
        result = simpel(tmp_path, *words)
        assert result.code == 0
        for verb in ("fit", "evaluate", "sweep", "simulate"):
            assert verb in result.out

    def test_version(self, tmp_path: Path) -> None:
        assert run(tmp_path, "--version").split() == ["simpel", metadata.version("simpel")]

    @pytest.mark.parametrize("verb", VERBS)
    def test_help_of_a_verb_has_two_examples(self, verb: str, tmp_path: Path) -> None:
        assert len(re.findall(rf"^\s*simpel {verb}(?: \S|\s*$)", run(tmp_path, verb, "--help"), re.M)) >= 2

    def test_help_shows_lists_in_brackets(self, tmp_path: Path) -> None:
        """Brackets are markup to what prints the help, unless they are escaped."""
        assert "'effect=[viscous_friction,coulomb_friction,input_delay]'" in run(tmp_path, "discover", "--help")

    def test_help_imports_nothing_heavy(self) -> None:
        code = (
            "import sys; import simpel_cli.main; "
            "print(*{'jax', 'hydra', 'omegaconf', 'numpy', 'casadi', 'matplotlib', 'pyarrow'} & set(sys.modules))"
        )
        words = [sys.executable, "-c", code]
        found = subprocess.run(words, capture_output=True, text=True, check=True, env=environment())
        assert found.stdout.strip() == ""


def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("simpel_cli.runs.manifest.write_text", full)
    result = simpel(tmp_path, *FIT, "hydra.run.dir=run")
    assert result.code == 1
    assert "run/manifest.json: No space left on device. What was complete before is kept; make room" in result.err


def test_scalars_for_tensorboard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = simpel(tmp_path, *FIT, "run.tensorboard=true", "hydra.run.dir=run")
    assert result.code == 0, result.err
    (events,) = (tmp_path / "run" / "tensorboard").iterdir()
    for tag in (b"train/loss", b"train/noise_std/omega", b"test/nll/joint"):
        assert tag in events.read_bytes()
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    result = simpel(tmp_path, *FIT, "run.tensorboard=true", "hydra.run.dir=without")
    assert (result.code, "pip install 'simpel[tensorboard]'" in result.err) == (2, True)
