"""Messages name the file and the line of the key that they begin with, if it comes from a file."""

from pathlib import Path

import pytest
from command_line import CART, RIG, rig, simpel

from simpel_cli.config.places import Layer, with_place
from simpel_cli.errors import ConfigError, DataError, NumericsError

FIT = ("fit", "--config-dir", "conf", "data=rig")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder in which `conf/` has a simulator with defaults of another, data and an experiment."""
    rig(tmp_path)
    conf = tmp_path / "conf"
    for name, text in {
        "sim/cart": CART,
        "sim/light": "defaults: [cart, _self_]\nparameters:\n  m:\n    range: [2, 1]\n",
        "data/rig": RIG.replace("../run.csv", "../../run.csv"),
        "experiment/wrong": "# @package _global_\ndefaults:\n  - override /sim: cart\n\ndata:\n  n_train: -3\n",
    }.items():
        (conf / f"{name}.yaml").parent.mkdir(parents=True, exist_ok=True)
        (conf / f"{name}.yaml").write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "end"),
    [
        (("sim=light",), "swap them (conf/sim/light.yaml, line 4)\n"),
        (("experiment=wrong",), "only a whole number of at least 0. (conf/experiment/wrong.yaml, line 6)\n"),
        (("sim=cart", "sim.parameters.k.range=[9,1]"), "low = 9 is not below high = 1; swap them\n"),
        (("sim=cart", "sim.parameters.k={range: [9, 1]}"), "low = 9 is not below high = 1; swap them\n"),
        (("sim=cart", "sim.parameters.k.prior=norml"), "Did you mean normal?\n"),
        # beside a word of the command line the rest comes from the file
        (("sim=light", "sim.parameters.m.prior=normal"), "swap them (conf/sim/light.yaml, line 4)\n"),
        (("sim=pendulum", "+sim.states.phi.limits=[0, 1]"), "a periodic state has no ends; leave limits out\n"),
        (("sim=pendulum", "sim.states.omega.unit=3"), "for a number without unit\n"),
    ],
)  # fmt: skip
def test_of_a_composition(words: tuple[str, ...], end: str, folder: Path) -> None:
    result = simpel(folder, *FIT, *words)
    assert result.code == 2
    assert result.err.endswith(end), result.err


def test_of_a_group_under_another_name(folder: Path) -> None:
    (folder / "conf" / "sim" / "pend.yaml").write_text(
        "defaults: [pendulum_high_fidelity, _self_]\nparameters: {g: a}\n"
    )
    words = ("rl-offline", "--config-dir", "conf", "experiment=pendulum_swing_up", "sim@truth=pend")
    result = simpel(folder, *words)
    assert result.code == 2
    assert "error: truth.parameters.g: uses a, which is no parameter" in result.err
    assert result.err.endswith(" (conf/sim/pend.yaml, line 2)\n")


def test_of_the_jobs_of_a_sweep(folder: Path) -> None:
    result = simpel(folder, "sweep", *FIT[1:], "sim=light,cart", "data.n_train=-1", "hydra.sweep.dir=sweep")
    assert result.code == 2
    assert "swap them (conf/sim/light.yaml, line 4); 1: data.n_train: -1 is not allowed" in result.err
    assert result.err.endswith("only a whole number of at least 0.\n")  # that was given on the command line


def test_an_expression_keeps_its_caret(folder: Path) -> None:
    (folder / "conf" / "sim" / "cart.yaml").write_text(CART.replace("s: v\n", "s: v + q\n"))
    for words in ((*FIT, "sim=cart"), ("sims", "cart", "--config-dir", "conf")):
        shown = simpel(folder, *words).err.splitlines()
        assert shown[0].endswith("known here: c, k, m, s, u, v, pi. (conf/sim/cart.yaml, line 14)")
        assert shown[1:] == ["  v + q", "      ^"]


def test_simpels_own_files_and_what_is_missing(folder: Path, tmp_path: Path) -> None:
    own = Layer(Path(__file__).parents[2] / "conf" / "sim" / "pendulum.yaml", ("sim",))
    assert str(with_place(ConfigError("sim.states.phi.range: no"), [own])).startswith(
        "sim.states.phi.range: no (conf/sim/pendulum.yaml, line "
    )
    # a key that is not there: where it belongs
    assert str(with_place(DataError("sim.states.phi.limits: no"), [own])).endswith("pendulum.yaml, line 6)")
    assert str(with_place(ConfigError("sim.gapp: no"), [own])) == "sim.gapp: no (conf/sim/pendulum.yaml)"
    for untouched in ("sim: no", "no key: here", "method.steps: no", "run.csv is missing", ""):
        assert str(with_place(ConfigError(untouched), [own])) == untouched
    assert str(with_place(NumericsError("sim.dt: no"), [own])) == "sim.dt: no"
    entries = tmp_path / "x.yaml"
    entries.write_text("path:\n- a\n- b\n")
    assert str(with_place(ConfigError("data.path[1]: no"), [Layer(entries, ("data",))])).endswith("x.yaml, line 3)")
