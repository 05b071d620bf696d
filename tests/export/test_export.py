"""What is exported computes what simpel computes: CasADi and C against a fit's transitions, numpy against its posterior."""

import ctypes
import json
import shutil
import subprocess
import sys
from pathlib import Path

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_line import FIT, TINY, rig, simpel

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.config.resolved import load
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.runs.manifest import FORMAT
from simulators.model import Model
from simulators.step import one_step

# in the states, in coordinates of its own, with limits, late by whole rows, late and lagging by parameters, static
SIMS = ("pendulum", "racecar", "cascaded_tanks", "parking_high_fidelity", "rc_car_high_fidelity", "sinusoids")
LATE = """
_target_: simulators.model.Declared
name: late
dt: 0.1
substeps: 3
states: {v: {unit: m/s, range: [-1, 1], limits: [-0.5, 0.6]}}
inputs: {u: {range: [-1, 1], delay: d, lag: tau}, w: {range: [-1, 1], lag: 0.07}}
parameters: {d: {range: [0.0, 0.25]}, tau: {range: [0.001, 0.1]}}
dynamics: {v: u + 2*w - v}
outputs: {a: u - v}
"""


def model_of(node: dict[str, object]) -> Model:
    return build(node, "sim").model()


def nodes_of(name: str, tmp_path: Path) -> dict[str, object]:
    if name != "late":
        return load(conf_dir() / "sim" / f"{name}.yaml")
    (tmp_path / "late.yaml").write_text(LATE)
    return load(tmp_path / "late.yaml")


def points(model: Model, n: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, stacked inputs and parameters within their ranges."""
    random = np.random.default_rng(1)
    groups = (model.states, model.inputs * (model.past() + 1), model.params)
    return tuple(
        np.array([[random.uniform(q.low, q.high) for q in group] for _ in range(n)]).reshape(n, len(group))
        for group in groups
    )


@pytest.mark.parametrize("name", [*SIMS, "late"])
def test_casadi_computes_a_fit_s_transitions(name: str, tmp_path: Path) -> None:
    model = model_of(nodes_of(name, tmp_path))
    path = tmp_path / "simulator.casadi"
    one_step(model).save(str(path))
    step = casadi.Function.load(str(path))
    encoding = encoding_of(model, tuple(q.name for q in model.outputs), model.past())
    fitted = jax.jit(transition(model, encoding).step)
    for s, u, p in zip(*points(model), strict=True):
        following, y = (np.asarray(value).ravel() for value in step(s, u, p))
        target = encoding.to_y(s, following, y)
        np.testing.assert_allclose(target, fitted(jnp.asarray(encoding.to_x(s, u)), jnp.asarray(p)), atol=1e-9)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fitted")
    result = simpel(folder, *FIT, "run.seeds=2", "hydra.run.dir=fit")
    assert result.code == 0, result.err
    return folder / "fit"


def test_c_computes_what_casadi_does(fitted: Path, tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here")
    assert simpel(tmp_path, "export", fitted, "--out", "out").code == 0
    out = tmp_path / "out"
    assert sorted(p.name for p in out.iterdir()) == [
        "posterior.json", "posterior.safetensors", "predictor.py",
        "simulator.c", "simulator.casadi", "simulator.h", "simulator.json", "simulator.yaml",
    ]  # fmt: skip
    library = tmp_path / "simulator.so"
    words = [
        compiler,
        "-O2",
        "-shared",
        "-fPIC",
        "-Wall",
        "-Werror",
        str(out / "simulator.c"),
        "-o",
        str(library),
        "-lm",
    ]
    subprocess.run(words, check=True)
    facts = json.loads((out / "simulator.json").read_text())
    compiled = ctypes.CDLL(str(library))
    function = getattr(compiled, facts["function"])
    sizes = [ctypes.c_longlong() for _ in range(4)]
    assert getattr(compiled, f"{facts['function']}_work")(*map(ctypes.byref, sizes)) == 0
    most_arguments, most_results, integers, reals = (size.value for size in sizes)
    pointer = ctypes.POINTER(ctypes.c_double)
    step = casadi.Function.load(str(out / "simulator.casadi"))
    model = model_of(load(out / "simulator.yaml"))
    assert [q["name"] for q in facts["p"]] == [q.name for q in model.params]
    for point in zip(*points(model), strict=True):
        given = [np.ascontiguousarray(part, float) for part in point]
        found = np.zeros(len(model.states)), np.zeros(1)
        arguments = (pointer * most_arguments)(*(part.ctypes.data_as(pointer) for part in given))
        results = (pointer * most_results)(*(part.ctypes.data_as(pointer) for part in found))
        status = function(arguments, results, (ctypes.c_longlong * integers)(), (ctypes.c_double * reals)(), 0)
        assert status == 0
        np.testing.assert_allclose(found[0], np.asarray(step(*point)[0]).ravel(), rtol=1e-14)


USE = """
import json, sys
from predictor import Predictor
predictor = Predictor(".")
now = predictor.step({"phi": 3.1, "omega": 0.3}, {"u": 1.5})
course = predictor.run({"phi": 3.1, "omega": 0.3}, [{"u": 1.5}] * 4)
assert not {"jax", "simpel_cli", "pandas"} & set(sys.modules)
print(json.dumps({"mean": now.mean, "std": now.std, "course": course.tolist()}))
"""


def test_numpy_predicts_what_the_posterior_does(fitted: Path, tmp_path: Path) -> None:
    from simpel_cli.studies.declared import declare
    from simpel_cli.studies.open import open_study
    from simpel_cli.studies.prepare import posteriors, prepare
    from simpel_cli.studies.training import checkpointed_state

    assert simpel(tmp_path, "export", fitted, "--out", "out", "--seed", "1").code == 0
    shown = subprocess.run(
        [sys.executable, "-c", USE], cwd=tmp_path / "out", capture_output=True, text=True, timeout=120
    )
    assert shown.returncode == 0, shown.stderr
    found = json.loads(shown.stdout)
    study = open_study(declare(load(fitted / "config.yaml")), fitted)
    _, state, bound = checkpointed_state(fitted, prepare(study))
    posterior, encoding = posteriors(study, bound, state)[1], study.system.encoding
    s, u = np.array([[3.1, 0.3]]), np.array([[1.5]])
    members = np.asarray(posterior.members(np.repeat(encoding.to_x(s, u)[None], posterior.particles, axis=0)))
    following = encoding.decode(encoding.encode(s)[None] + members)[:, 0]
    course = np.array(found["course"])
    assert course.shape == (posterior.particles, 5, 2)
    np.testing.assert_allclose(course[:, 1], following, atol=2e-6)
    noise = np.asarray(posterior.predict(encoding.to_x(s, u)).noise_std)
    assert found["mean"]["omega"] == pytest.approx(following[:, 1].mean(), abs=2e-6)
    assert found["std"]["omega"] == pytest.approx((following[:, 1].var() + noise[2] ** 2) ** 0.5, rel=1e-4)


def test_what_is_not_exported_need_not_be_installed(fitted: Path, tmp_path: Path) -> None:
    shutil.copytree(fitted, tmp_path / "run")
    config = load(tmp_path / "run" / "config.yaml")
    config["run"]["plugins"], config["score"]["_target_"] = ["gone"], "gone.Score"
    (tmp_path / "run" / "config.yaml").write_text(json.dumps(config))
    result = simpel(tmp_path, "export", "run", "--out", "out")
    assert (result.code, result.err) == (0, "")
    assert (tmp_path / "out" / "posterior.safetensors").exists()


def test_the_simulator_that_discover_corrected(fitted: Path, tmp_path: Path) -> None:
    run = tmp_path / "found"
    (run / "conf" / "sim").mkdir(parents=True)
    my = rig(tmp_path)
    cart = load(my / "sim" / "cart.yaml")
    (run / "config.yaml").write_text(json.dumps(load(fitted / "config.yaml") | {"sim": cart}))
    (run / "manifest.json").write_text(json.dumps({"format": FORMAT, "command": "discover", "status": "done"}))
    (run / "conf" / "sim" / "cart_with_leak.yaml").write_text(
        json.dumps(cart | {"name": "cart_with_leak", "parameters": cart["parameters"] | {"b": {"range": [0.1, 0.3]}}})
    )
    verdict = {
        "verdict": "effect", "corrected_sim": "conf/sim/cart_with_leak.yaml",
        "parameters": {"m": {"after": {"value": 1.21}}, "k": {"after": {"value": 19.5}}},
        "effects": [{"name": "leak", "parameters": {"b": {"value": 0.22}}}],
        "groups": [{"parameter": "k", "per": "rig", "values": {"one": {"value": 18.0}, "two": {"value": 21.0}}}],
    }  # fmt: skip
    (run / "verdict.json").write_text(json.dumps(verdict))
    result = simpel(tmp_path, "export", run)
    assert (result.code, result.err) == (0, "")
    assert "corrected; parameters as identified" in result.out
    facts = json.loads((run / "export" / "simulator.json").read_text())
    assert [(q["name"], q["value"]) for q in facts["p"]] == [("m", 1.21), ("k", 19.5), ("b", 0.22)]
    assert facts["name"] == "cart_with_leak"
    assert [(q.get("per"), q.get("values")) for q in facts["p"][:2]] == [
        (None, None),
        ("rig", {"one": 18.0, "two": 21.0}),
    ]
    assert "k has a value for every rig, here what they have in common" in " ".join(result.out.split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nowhere",), "nowhere"),
        (("FIT", "--seed", "7"), "--seed: got 7; the run has 0, 1."),
        (("FIT", "--out", "file"), "--out: cannot write to file"),
        (("begun",), "begun: running, not done. Go on with it first: simpel fit --resume begun"),
        (("simulated",), "made by `simpel simulate`; export takes the directory of fit, discover, rl-offline."),
    ],
)
def test_wrong_exports(fitted: Path, tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    (tmp_path / "file").touch()
    for name, verb in (("begun", "fit"), ("simulated", "simulate")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "manifest.json").write_text(json.dumps({"command": verb, "status": "running"}))
    result = simpel(tmp_path, "export", *(str(fitted) if word == "FIT" else word for word in words))
    assert result.code == 2
    assert message in result.err


@pytest.mark.slow  # two more fits for two messages
def test_what_has_no_networks_of_its_own(tmp_path: Path) -> None:
    words = [
        word
        for word in TINY
        if not word.startswith(("method.particles", "method.network", "method.pool", "method.sets"))
    ]
    assert simpel(tmp_path, "fit", "experiment=pendulum", "method=sysid", *words, "hydra.run.dir=fit").code == 0
    result = simpel(tmp_path, "export", "fit")
    assert result.code == 2
    assert "method=sysid has no networks alone that could be written" in result.err
    assert (tmp_path / "fit" / "export" / "simulator.casadi").exists()


def test_the_predictor_looks_at_the_next_value_of_an_input_that_is_linear(tmp_path: Path) -> None:
    """One network, which says what its last input is: u at the next row; after the last row it stays."""
    from safetensors.numpy import save_file

    from simpel_cli.export.predictor import Predictor

    facts = {
        "states": [{"name": "w", "unit": "", "angle": False}], "outputs": [], "past_inputs": 0, "next_inputs": ["u"],
        "inputs": [{"name": n, "unit": ""} for n in ("f", "u")], "negative_slope": 0.01,
    }  # fmt: skip
    (tmp_path / "posterior.json").write_text(json.dumps(facts))
    one = {"y_mean": 1, "y_std": 1, "x_mean": 4, "x_std": 4}
    arrays = {name: (np.ones if "std" in name else np.zeros)(size) for name, size in one.items()}
    arrays |= {
        "noise_std": np.ones(1),
        "kernel_0": np.array([[[0.0], [0.0], [0.0], [1.0]]]),
        "bias_0": np.zeros((1, 1)),
    }
    save_file(arrays, tmp_path / "posterior.safetensors")
    predictor = Predictor(tmp_path)
    commands = [{"f": 9.0, "u": u} for u in (1.0, 2.0, 4.0)]
    np.testing.assert_allclose(np.diff(predictor.run({"w": 0.0}, commands)[0, :, 0]), [2.0, 4.0, 4.0])
    assert predictor.step({"w": 0.0}, commands[0]).mean["w"] == 1.0
    assert predictor.step({"w": 0.0}, commands[0], following={"u": 7.0}).mean["w"] == 7.0


@pytest.mark.parametrize("activation", ["leaky_relu", "silu", "tanh", None])
def test_the_predictor_has_the_activation_of_the_networks(tmp_path: Path, activation: str | None) -> None:
    """Two networks of one hidden layer; what was exported before activations had names has a leaky ReLU."""
    from safetensors.numpy import save_file

    from simpel_cli.export.predictor import Predictor
    from simpel_cli.inference.networks import MLP

    slope = 0.2 if activation in ("leaky_relu", None) else 0.01
    network = MLP((4,), slope, activation or "leaky_relu")
    layers = jax.vmap(lambda key: network.init(key, 1, 1, jnp.dtype(jnp.float32)))(jax.random.split(jax.random.key(0)))
    facts = {
        "states": [{"name": "w", "unit": "", "angle": False}], "inputs": [], "outputs": [], "past_inputs": 0,
        "next_inputs": [], "negative_slope": slope,
    } | ({} if activation is None else {"activation": activation})  # fmt: skip
    (tmp_path / "posterior.json").write_text(json.dumps(facts))
    arrays = {name: (np.ones if "std" in name else np.zeros)(1) for name in ("x_mean", "x_std", "y_mean", "y_std")}
    for i, (kernel, bias) in enumerate(layers):
        arrays |= {f"kernel_{i}": np.asarray(kernel), f"bias_{i}": np.asarray(bias)}
    save_file(arrays | {"noise_std": np.ones(1)}, tmp_path / "posterior.safetensors")
    x = np.linspace(-40, 40, 9)[:, None]
    expected = network.apply_all(layers, jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(Predictor(tmp_path).targets(x), expected, rtol=1e-4, atol=1e-4)
