"""What a user can get wrong: the message names key or file, what was given, what is allowed and the cure; exit codes."""

import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import CART, RIG, TINY, csv, environment, process, rig, simpel, start, swing

OWN = ("fit", "--config-dir", "my", "sim=cart", "data=rig", *TINY)
CONFIG, DATA, NUMERICS = 2, 3, 4


class Case(NamedTuple):
    name: str
    words: tuple[str, ...]
    code: int
    fragments: tuple[str, ...]  # of the message, all of them
    prepare: Callable[[Path], object] | None = None


def case(
    name: str, words: str | tuple[str, ...], code: int, *fragments: str, prepare: Callable[[Path], object] | None = None
) -> Case:
    return Case(name, tuple(words.split()) if isinstance(words, str) else words, code, fragments, prepare)


def own(name: str, code: int, *fragments: str, extra: tuple[str, ...] = (), **files: str | bytes) -> Case:
    """A case of a user's own simulator and measurements."""
    return Case(name, (*OWN, *extra), code, fragments, lambda folder: rig(folder, **files))  # type: ignore[arg-type]


def sim(name: str, old: str, new: str, *fragments: str) -> Case:
    """A case of one wrong line in a user's own simulator."""
    assert old in CART
    return own(name, CONFIG, *fragments, cart=CART.replace(old, new))


def change(row: int, column: int, value: object) -> str:
    table: list[list[object]] = [list(r) for r in swing()]
    table[row][column] = value
    return csv(table)


def truncated() -> bytes:
    buffer = io.BytesIO()
    pq.write_table(pa.table({"run": [0, 1, 2]}), buffer)
    return buffer.getvalue()[:-40]


def latin(folder: Path) -> None:
    path = rig(folder) / "sim" / "cart.yaml"
    path.write_bytes(CART.encode() + b"# r\xe9sum\xe9\n")


CASES = [
    # keys and groups
    case("typo in a key", "fit experiment=pendulum method.stpes=2000", CONFIG, "method.stpes: no such key in FSVGD",
         "Did you mean method.steps?", "steps: int = 5000, number of SVGD steps"),
    case("typo in a nested key", "fit method.network.hiden=[8]", CONFIG, "Did you mean method.network.hidden?"),
    case("typo in a group", "fit metod=fsvgd", CONFIG, "metod: no such key or group of `simpel fit`", "Did you mean method?"),
    case("typo in a dotted group", "fit metod.steps=3", CONFIG, "metod: no such key or group", "Did you mean method?"),
    case("unknown option", "fit method=simple", CONFIG, "method: no option 'simple'", "Did you mean simpel?",
         "available: ensemble, fsvgd"),
    case("experiment that does not exist", "fit experiment=pendulun", CONFIG, "experiment: no option 'pendulun'",
         "Did you mean pendulum?"),
    case("own data without --config-dir", "fit data=rig", CONFIG, "data: no option 'rig'", "available: "),
    case("group set to null", "fit sim=null", CONFIG, "a group cannot be null"),
    case("key of another verb", "simulate sim=pendulum method.steps=3", CONFIG,
         "method: no such key or group of `simpel simulate`", "it has: run, sim, simulation, out"),
    case("unknown key of Hydra", "fit hydra.sweeep.dir=x", CONFIG, "hydra.sweeep.dir: no such key", "--cfg hydra"),
    case("unknown launcher", "sweep hydra/launcher=joblib method.steps=1,2", CONFIG, "hydra/launcher: no option 'joblib'"),
    # values
    case("text for a number", "fit method.steps=abc", CONFIG, "method.steps: got 'abc'; expected an integer"),
    case("fraction for an integer", "fit method.steps=1.5", CONFIG, "method.steps: got 1.5; expected an integer"),
    case("nothing for a number", "fit method.steps=", CONFIG, "method.steps: got ''; expected an integer"),
    case("number for a list", "fit method.network.hidden=64", CONFIG, "method.network.hidden: got 64; expected a list"),
    case("text for a switch", "fit run.cache=maybe", CONFIG, "run.cache: got 'maybe'; expected true or false"),
    case("negative seed", "fit run.seed=-1", CONFIG, "run.seed: got -1; allowed are 0 to"),
    case("no seeds", "fit run.seeds=0", CONFIG, "run.seeds: got 0; allowed are 1 to"),
    case("no steps", "fit method.steps=0", CONFIG, "method.steps: got 0; it must be at least 1"),
    case("layer without width", "fit method.network.hidden=[0]", CONFIG, "method.network.hidden: got [0]", "at least 1"),
    case("learning rate not a number", "fit method.learning_rate=nan", CONFIG, "method.learning_rate: got nan"),
    case("unknown precision", "fit run.precision=float16", CONFIG, "got 'float16'; allowed are float32 and float64"),
    case("unknown device", "fit run.device=gpus", CONFIG, "run.device: got 'gpus'; allowed are auto, cpu and gpu"),
    case("unknown score option", "fit score.shrinkage=foo", CONFIG, "got 'foo'; allowed are none and ledoit_wolf"),
    case("negative horizon", "fit evaluation.horizon=-1", CONFIG, "evaluation.horizon: got -1.0; it must be positive"),
    case("precision of discover", "discover run.precision=nonsense", CONFIG, "run.precision: got 'nonsense'; allowed are"),
    # form
    case("no sign", "fit method.steps", CONFIG, "method.steps: not of the form key=value", "e.g. method.steps=2000"),
    case("blanks around the sign", ("fit", "method.steps = 5"), CONFIG, "without blanks around the sign"),
    case("open bracket", "fit method.network.hidden=[8", CONFIG, "the value cannot be read", "A list is written [1,2]"),
    case("expression without quotes", "fit sim.dynamics.omega=(m*g)/I", CONFIG, "the value cannot be read",
         """'sim.dynamics.omega="(m*g)/I"'"""),
    case("several values for fit", "fit method.steps=10,20", CONFIG, "several values", "simpel sweep method.steps=10,20"),
    case("unknown verb", "fti", CONFIG, "No such command 'fti'", "Did you mean 'fit'?"),
    case("unknown flag", "fit --steps 5", CONFIG, "No such option: --steps", "simpel fit --help"),
    case("unknown --cfg", "fit --cfg jobs", CONFIG, "got 'jobs'; allowed are job, hydra and all"),
    # targets
    case("option of a wrong class", "fit prior.gap.kernel._target_=simpel_cli.priors.gaussian_process.Matern12", CONFIG,
         "prior.gap.kernel._target_", "Did you mean Matern52?", "SquaredExponential"),
    case("score as method", "fit method._target_=simpel_cli.scores.gaussian.Gaussian", CONFIG, "is no method"),
    case("removed _target_", "fit ~method._target_", CONFIG, "method: the key _target_ is missing"),
    sim("target os.system", "simulators.model.Declared", "os.system", "sim._target_: got os.system",
        "allowed are classes of simpel_cli, simulators"),
    sim("target read_pickle", "simulators.model.Declared", "pandas.read_pickle", "got pandas.read_pickle"),
    sim("target is a function", "simulators.model.Declared", "simulators.expression.parse", "is not a dataclass"),
    sim("root of something negative", "(c*u - k*s)/m", "(c*u - k*s)/m - sqrt(s)",
        "sim: cart is not finite after one transition from state s = -0.", "input u = ", "parameters m = ", "sqrt(max(h, 0))"),
    sim("typo in a class", "simulators.model.Declared", "simulators.model.Declard", "Did you mean Declared?"),
    sim("typo in a module", "simulators.model.Declared", "simulators.modl.Declared", "cannot import simulators.modl"),
    sim("target without module", "simulators.model.Declared", "Declared", "sim._target_: got Declared"),
    # the simulator's YAML
    sim("no range", "{unit: m,   range: [-0.5, 0.5]}", "{unit: m}", "sim.states.s: no range; add `range: [low, high]`"),
    sim("range reversed", "[0.5, 2.0]", "[2.0, 0.5]", "sim.parameters.m.range: low = 2 is not below high", "swap them"),
    sim("unknown state in dynamics", "  s: v\n", "  s: v\n  w: v\n", "sim.dynamics.w: is no state; known: s, v"),
    sim("no dynamics of a state", "  s: v\n", "", "no entry for the state s; add `s: <its time derivative>`"),
    sim("unknown symbol", "k*s", "kk*s", "sim.dynamics.v: unknown name 'kk'", "known here: c, k, m",
        "\n  (c*u - kk*s)/m\n         ^"),
    sim("caret for a power", "k*s", "k*s^2", "`^` is not allowed: write ** for a power"),
    sim("hostile expression", "(c*u - k*s)/m", "__import__('os').system('touch pwned')", "sim.dynamics.v", "not allowed"),
    sim("a name that YAML reads as false", "  c: 2.0\n", "  c: 2.0\n  no: 1.0\n", "a name became False", 'quote it ("no"'),
    sim("no dt", "dt: 0.05\n", "", "sim.dt: missing", "duration of one transition, s"),
    sim("dt is text", "dt: 0.05\n", "dt: fast\n", "sim.dt: got 'fast'; expected a number"),
    sim("no name", "name: cart\n", "", "sim.name: missing"),
    sim("YAML syntax", "states:", "states: {a: [1,", "my/sim/cart.yaml, line ", "not valid YAML"),
    sim("YAML with a tab", "  u: {unit", "\tu: {unit", "my/sim/cart.yaml, line 8, column 1: not valid YAML"),
    sim("key twice", "dt: 0.05\n", "dt: 0.05\ndt: 0.1\n", "my/sim/cart.yaml, line 4", "duplicate key dt"),
    own("empty YAML", CONFIG, "sim.name: missing", cart=""),
    own("YAML is a list", CONFIG, "sim.name: missing", cart="- a\n- b\n"),
    case("YAML not UTF-8", OWN, CONFIG, "my/sim/cart.yaml: not UTF-8 text", "Save it in UTF-8", prepare=latin),
    sim("interpolation of nothing", "c: 2.0", "c: ${nope}", "sim.parameters.c: ${nope} names a key that does not exist"),
    sim("open interpolation", "c: 2.0", "c: ${nope", "parameters.c", "'${nope' is no complete ${...}"),
    sim("absent environment variable", "c: 2.0", "c: ${oc.env:SIMPEL_NOPE}", "SIMPEL_NOPE is not set", "DEFAULT"),
    sim("unknown resolver", "c: 2.0", "c: ${foo:1}", "${foo:...} is unknown; allowed are ${oc.env:NAME}"),
    sim("mandatory value", "c: 2.0", "c: ???", "sim.parameters.c: a value must be given", "sim.parameters.c=VALUE"),
    case("hostile override", ("fit", "sim.dynamics.omega=\"__import__('os').system('touch pwned')\""), CONFIG,
         "sim.dynamics.omega", "not allowed"),
    # measurements
    own("no file", DATA, "data.path: '../run.csv' was not found. Tried: ", "my/run.csv", measurements=b"absent"),
    case("no file in the working directory", "fit data.path=nowhere.csv", DATA, "/conf/data/nowhere.csv, ", "/nowhere.csv."),
    own("no such column", DATA, "column 'velocity' is missing in run.csv (it has: run, t, pos, vel, volts)",
        "`columns: {v: null}`", data=RIG.replace("vel", "velocity")),
    own("unknown quantity", CONFIG, "data.columns.w: the simulator has no such quantity (it has: s, v, u)",
        data=RIG.replace("v: vel", "w: vel")),
    own("typo in a data key", CONFIG, "data.column: no such key", "Did you mean data.columns?",
        data=RIG.replace("columns", "column")),
    own("input not measured", DATA, "data.columns.u: an input cannot be estimated", data=RIG.replace("u: volts", "u: null")),
    own("text in a number column", DATA, "column 'pos' of run.csv", "line 9 has 'abc'", measurements=change(7, 2, "abc")),
    own("other unit", DATA, "unit of column 'pos' in run.csv is mm, but the simulator has 's' in m", "Convert the column",
        data=RIG + "units: {s: mm}\n"),
    case("degrees", "fit data.units.phi=deg", DATA, "is deg, but the simulator has 'phi' in rad", "pi/180"),
    own("time runs backwards", DATA, "time runs backwards at line 9 of run.csv, episode 0", "Sort the file",
        measurements=change(7, 1, 0.0)),
    own("empty file", DATA, "run.csv is empty (0 bytes)", measurements=b""),
    own("header only", DATA, "run.csv has a header (run, t, pos, vel, volts) but no rows", measurements=csv([])),
    own("no header", DATA, "run.csv starts with numbers", measurements=csv(swing()).partition("\n")[2]),
    own("short line", DATA, "run.csv has 5 columns, but record 182", measurements=csv(swing()) + "1,2,3\n"),
    own("decimal commas and points", DATA, "column 't' of run.csv should hold numbers, but line 3 has '0,05'",
        "Write all numbers with a decimal point", measurements=csv(swing()).replace(",", ";").replace("0.05", "0,05")),
    own("another sampling time", DATA, "the rows are 0.1 s apart, but simulator 'cart' has dt = 0.05 s", "data.resample: 0.05",
        measurements=csv(swing(dt=0.1))),
    own("time in ms", DATA, "The time looks like ms", measurements=csv(swing(dt=50))),
    own("one row per episode", DATA, "too few rows: none of 6 rows follows another", measurements=csv(swing(rows=1))),
    own("one episode", DATA, "there is one episode only", "by: time", measurements=csv(swing(episodes=1))),
    own("nothing moves", DATA, "nothing changes: s, v are constant",
        measurements=csv([[*row[:2], 1, 1, row[4]] for row in swing()])),
    own("more than there is", DATA, "data.n_train: 100000 training transitions are asked for", extra=("data.n_train=100000",)),
    own("no transitions", CONFIG, "data.n_train: -1 is not allowed", extra=("data.n_train=-1",)),
    own("split column missing", DATA, "column 'part' is missing", "data.split.column",
        data=RIG.replace("{test_fraction: 0.25, by: episode}", "{column: part}")),
    own("fraction above one", CONFIG, "data.split.test_fraction: 2 is not allowed", extra=("data.split.test_fraction=2",)),
    own("resampling to another dt", CONFIG, "data.resample: 0.1 s is not the dt of simulator 'cart'",
        extra=("data.resample=0.1",)),
    # places
    case("run directory below a file", ("fit", *TINY, "hydra.run.dir=/dev/null/x"), CONFIG,
         "hydra.run.dir: cannot write to /dev/null/x (Not a directory)", "hydra.run.dir=DIR"),
    case("folder of data below a file", "simulate sim=pendulum out=/dev/null/x", CONFIG, "out: cannot write to /dev/null/x"),
    case("no such --config-dir", "fit --config-dir nowhere", CONFIG, "--config-dir: nowhere is not a folder"),
    case("resume what is no run", "fit --resume .", CONFIG, "not a run directory (it has no manifest.json)"),
    case("resume with overrides", "fit --resume . method.steps=5", CONFIG, "--resume: a resumed run takes nothing else"),
    case("evaluate what is no run", "evaluate .", CONFIG, "not a run directory"),
    case("evaluate without a run", "evaluate", CONFIG, "Missing argument"),
    case("evaluate, run forgotten", "evaluate data=pendulum", CONFIG, "simpel evaluate RUN_DIR data=pendulum"),
    case("noise of nothing", "simulate sim=pendulum simulation.noise_std.phii=1", CONFIG, "Did you mean phi?"),
    case("no episodes", "simulate sim=pendulum simulation.episodes=-1", CONFIG, "simulation.episodes: -1 is not allowed"),
    case("law of noise", "simulate sim=pendulum simulation.noise={phi:{law:student}}", CONFIG,
         "simulation.noise.phi.law: 'student' is not allowed", "Did you mean student_t?"),
    case("word in a law", "simulate sim=pendulum simulation.noise={phi:{lawe:student_t}}", CONFIG,
         "simulation.noise.phi.lawe: no such key", "Did you mean simulation.noise.phi.law?"),
    case("groups without a number", "simulate sim=pendulum simulation.groups={ball:{parameters:{l:{std:1}}}}", CONFIG,
         "simulation.groups.ball.count: missing"),
    case("clock of nothing", "simulate sim=pendulum simulation.clocks={phi:{ofset:1}}", CONFIG,
         "simulation.clocks.phi.ofset: no such key", "Did you mean simulation.clocks.phi.offset?"),
    case("unknown nuisance", "simulate sim=pendulum simulation.quantization.phi=1", CONFIG,
         "Did you mean simulation.quantisation?"),
    case("saturation that is no range", "simulate sim=pendulum simulation.saturates.phi=3", CONFIG,
         "simulation.saturates.phi: got 3; expected a list"),
    case("sweep over an unknown option", "sweep method=simpel,fsvg", CONFIG, "method: no option 'fsvg'"),
    case("sweep of an unknown group", "sweep metod=simpel,fsvgd", CONFIG, "metod: no such key", "Did you mean method?"),
    # numerics
    case("divergence", ("fit", *TINY, "method.learning_rate=1e30"), NUMERICS, "step 2: `loss` is not finite",
         "there is no checkpoint yet", "Try a smaller method.learning_rate"),
]  # fmt: skip


def table(path: str = os.environ.get("SIMPEL_WRONG_INPUTS", "")) -> Path | None:
    """File that gets every message, for a person to read."""
    return Path(path) if path else None


@pytest.mark.parametrize("wrong", CASES, ids=[c.name.replace(" ", "_") for c in CASES])
def test_message_and_exit_code(wrong: Case, tmp_path: Path) -> None:
    if wrong.prepare is not None:
        wrong.prepare(tmp_path)
    result = simpel(tmp_path, *wrong.words)
    if table() is not None:
        shown = " ".join(w for w in wrong.words if w not in TINY)
        message = result.err.strip().replace("\n", "<br>").replace("|", "\\|").replace(str(tmp_path), "DIR")
        with table().open("a") as file:  # type: ignore[union-attr]
            file.write(f"| {wrong.name} | `simpel {shown}` | {message} | {result.code} |\n")
    assert result.code == wrong.code, result.err
    assert result.err.startswith("error: ")
    for fragment in wrong.fragments:
        assert fragment in result.err
    assert "Traceback" not in result.err
    assert result.err.count("\n") <= 4  # one message; an expression is shown with its caret
    assert not (tmp_path / "pwned").exists()


def test_gpu_where_there_is_none(tmp_path: Path) -> None:
    import jax

    if jax.default_backend() == "gpu":
        pytest.skip("the refusal of run.device=gpu needs a machine where JAX sees no GPU; this one has one")
    result = simpel(tmp_path, "fit", "run.device=gpu", *TINY)
    assert result.code == CONFIG
    assert "run.device: got gpu; JAX sees cpu only. Use run.device=auto" in result.err


def test_truncated_parquet(tmp_path: Path) -> None:
    my = rig(tmp_path, data=RIG.replace("run.csv", "run.parquet"))
    (my / "run.parquet").write_bytes(truncated())
    result = simpel(tmp_path, *OWN)
    assert result.code == DATA
    assert "run.parquet is damaged, cut off or no Parquet file" in result.err


def test_a_missing_input_costs_its_row_and_a_missing_state_itself(tmp_path: Path) -> None:
    rig(tmp_path, measurements=change(40, 4, "nan"))
    words = (*OWN[:-1], "run.quiet=false")
    result = simpel(tmp_path, *words, "hydra.run.dir=input")
    assert result.code == 0, result.err
    assert "1 of 180 rows dropped, whose time or inputs are not known" in result.out
    (tmp_path / "my" / "run.csv").write_text(change(40, 2, "nan"))
    result = simpel(tmp_path, *words, "hydra.run.dir=state")
    assert result.code == 0, result.err
    report = (tmp_path / "state" / "report.html").read_text()
    assert "missing values, each of which costs itself only: 1 of pos" in report
    assert "estimated by the simulator" in report


def test_a_failed_start_leaves_its_directory_free(tmp_path: Path) -> None:
    """Correct the typo, press return: the same command with the same directory runs."""
    words = ("fit", *TINY, "method.steps=20", "hydra.run.dir=here")
    assert simpel(tmp_path, *words, "method.stpes=3").code == CONFIG
    assert simpel(tmp_path, *words).code == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a user's files and a finished run."""
    folder = tmp_path_factory.mktemp("of_a_run")
    rig(folder)
    assert simpel(folder, *OWN, "hydra.run.dir=run").code == 0
    return folder


class TestOfARun:
    @staticmethod
    def contents(folder: Path) -> dict[str, bytes]:
        return {str(p): p.read_bytes() for p in sorted((folder / "run").rglob("*")) if p.is_file()}

    @pytest.mark.parametrize("words", [("fit", *TINY), ("evaluate", "run"), ("simulate", "sim=pendulum")])
    def test_a_directory_that_holds_a_run_is_left_alone(self, folder: Path, words: tuple[str, ...]) -> None:
        before = self.contents(folder)
        result = simpel(folder, *words, "hydra.run.dir=run")
        assert result.code == CONFIG
        assert "hydra.run.dir: run holds a run already" in result.err
        assert self.contents(folder) == before

    def test_evaluate_on_other_quantities(self, folder: Path) -> None:
        result = simpel(folder, "evaluate", "run", "data=pendulum")
        assert result.code == CONFIG
        assert "data.noise_std.phi: the simulator has no such quantity (it has: s, v)" in result.err

    def test_evaluate_keeps_the_settings_of_the_fit(self, folder: Path) -> None:
        result = simpel(folder, "evaluate", "run", "run.seeds=3")
        assert result.code == CONFIG
        assert "run.seeds: evaluate keeps the run's own value; it takes run.quiet, run.device, run.cache" in result.err

    @pytest.mark.parametrize("word", ["data.n_train=5", "+data.path=other.csv"])
    def test_evaluate_takes_no_key_of_data_alone(self, folder: Path, word: str) -> None:
        result = simpel(folder, "evaluate", "run", word)
        key = word.lstrip("+").partition("=")[0]
        assert result.code == CONFIG
        assert result.err.startswith(f"error: {key}: evaluate keeps the run's own data; for another {key} fit again. ")
        assert "To test on other measurements, name them: data=NAME." in result.err
        assert "data=NAME and its keys, evaluation.horizon, run.quiet, run.device, run.cache)" in result.err
        assert result.err.count("\n") == 1

    def test_evaluate_takes_no_method(self, folder: Path) -> None:
        result = simpel(folder, "evaluate", "run", "method.steps=3")
        assert result.code == CONFIG
        assert "method: no such key or group of `simpel evaluate`" in result.err

    @pytest.mark.parametrize("verb", [("evaluate",), ("fit", "--resume")])
    def test_measurements_that_changed_since(self, folder: Path, tmp_path: Path, verb: tuple[str, ...]) -> None:
        shutil.copytree(folder / "run", tmp_path / "run")
        manifest = tmp_path / "run" / "manifest.json"
        manifest.write_text(manifest.read_text().replace('"done"', '"interrupted"'))
        measurements = folder / "my" / "run.csv"
        original = measurements.read_text()
        measurements.write_text(original + original.splitlines()[-1].replace("5,1.45", "5,1.50") + "\n")
        try:
            result = simpel(tmp_path, *verb, "run")
        finally:
            measurements.write_text(original)
        assert result.code == DATA
        assert "run.csv has changed since the run was started" in result.err

    @pytest.mark.parametrize("verb", [("evaluate",), ("fit", "--resume")])
    def test_truncated_checkpoint(self, folder: Path, tmp_path: Path, verb: tuple[str, ...]) -> None:
        shutil.copytree(folder / "run", tmp_path / "run")
        manifest = tmp_path / "run" / "manifest.json"
        manifest.write_text(manifest.read_text().replace('"done"', '"interrupted"'))
        state = tmp_path / "run" / "checkpoint" / "state.safetensors"
        state.write_bytes(state.read_bytes()[:-100])
        result = simpel(tmp_path, *verb, "run")
        assert result.code == CONFIG
        assert "state.safetensors: damaged or not a checkpoint of simpel" in result.err

    def test_a_configuration_that_was_cut_off(self, folder: Path, tmp_path: Path) -> None:
        shutil.copytree(folder / "run", tmp_path / "run")
        config = tmp_path / "run" / "config.yaml"
        text = config.read_text()
        config.write_text(text[: text.index("prior:")])
        for verb in ("evaluate", "export"):
            result = simpel(tmp_path, verb, "run")
            assert result.code == CONFIG
            assert "config.yaml: damaged or cut off (prior, score, method, choices missing). Restore it" in result.err

    def test_a_manifest_with_a_number_that_python_does_not_read(self, folder: Path, tmp_path: Path) -> None:
        shutil.copytree(folder / "run", tmp_path / "run")
        (tmp_path / "run" / "manifest.json").write_text('{"command": "fit", "seed": ' + 5000 * "9" + "}")
        result = simpel(tmp_path, "evaluate", "run")
        assert (result.code, "manifest.json: not readable" in result.err) == (CONFIG, True)

    def test_checkpoint_of_another_configuration(self, folder: Path, tmp_path: Path) -> None:
        shutil.copytree(folder / "run", tmp_path / "run")
        config = tmp_path / "run" / "config.yaml"
        config.write_text(config.read_text().replace("- 16\n", "- 8\n", 1))
        result = simpel(tmp_path, "evaluate", "run")
        assert result.code == CONFIG
        assert "The checkpoint belongs to another configuration" in result.err


def test_an_existing_data_set_is_left_alone(tmp_path: Path) -> None:
    words = ("simulate", "sim=sinusoid", "simulation.episodes=2", "simulation.steps=3", "out=made")
    assert simpel(tmp_path, *words).code == 0
    before = (tmp_path / "made" / "measurements.parquet").read_bytes()
    result = simpel(tmp_path, *words, "simulation.seed=5")
    assert result.code == CONFIG
    assert "measurements.parquet exists; remove it, or choose another folder" in result.err
    assert (tmp_path / "made" / "measurements.parquet").read_bytes() == before


def test_a_process_of_its_own_prints_one_line(tmp_path: Path) -> None:
    result = process(tmp_path, "fit", "method.stpes=2000")
    assert result.code == CONFIG
    assert result.out == ""
    assert result.err.startswith("error: method.stpes")
    assert len(result.err.splitlines()) == 1


def lines_of_a_run_that_is_done(directory: Path) -> list[str]:
    """Return what `run.log` says after the time stamps, of a run that must be done."""
    record = json.loads((directory / "manifest.json").read_text())
    assert (record["status"], record["error"]) == ("done", None)
    log = (directory / "run.log").read_text()
    return [line[24:] for line in log.splitlines() if re.match(r"\d{4}-\d\d-\d\d ", line)]


def test_a_run_goes_on_when_its_reader_goes_away(tmp_path: Path) -> None:
    """`simpel fit | head -1`"""
    with start(tmp_path, "fit", *TINY[:-1], "hydra.run.dir=run") as child:
        assert child.stdout is not None
        assert child.stderr is not None
        assert child.stdout.readline().startswith("simpel fit")
        child.stdout.close()
        assert child.stderr.read() == ""
    assert child.returncode == 0
    lines = lines_of_a_run_that_is_done(tmp_path / "run")
    assert [line.split()[0] for line in lines if line[0] != " "] == [
        "simpel", "data", "simulator", "noise", "prior", "test", "(intervals:", "report", "next",
    ]  # fmt: skip


@pytest.mark.slow  # as test_a_run_goes_on_when_its_reader_goes_away
def test_a_run_without_standard_output(tmp_path: Path) -> None:
    """`simpel fit >&-`"""
    words = ["-m", "simpel_cli.main", "fit", *TINY[:-1], "hydra.run.dir=run"]
    shell = ["sh", "-c", 'exec "$0" "$@" >&-', sys.executable, *words]
    result = subprocess.run(shell, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert lines_of_a_run_that_is_done(tmp_path / "run")[-2].startswith("next ")
