"""A run with an input that is linear between rows: later verbs take it so, and what contradicts is said."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import csv, rig, simpel, swing

from simpel_cli.data import Measurements
from simpel_cli.errors import ConfigError
from simpel_cli.studies.declared import Declared

FEW = ("method=sysid", "method.steps=3", "method.starts=2", "method.particles=3", "run.figures=false", "run.quiet=true")
NAMES = ("s", "v", "u")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("linear")
    my = rig(folder)
    (my / "later.csv").write_text(csv(swing(episodes=3)))
    (my / "data" / "later.yaml").write_text((my / "data" / "rig.yaml").read_text().replace("run.csv", "later.csv"))
    done = simpel(folder, "fit", "--config-dir", "my", "sim=cart", "data=rig", *FEW, "data.between_rows={u: linear}",
                  "hydra.run.dir=run")  # fmt: skip
    assert done.code == 0, done.err
    return folder


def test_other_data_are_taken_as_those_of_the_run(folder: Path) -> None:
    done = simpel(folder, "evaluate", "run", "--config-dir", "my", "data=later", "hydra.run.dir=tested")
    assert done.code == 0, done.err


def test_what_contradicts_the_run_is_said(folder: Path) -> None:
    done = simpel(folder, "evaluate", "run", "--config-dir", "my", "data=later", "data.between_rows={u: held}")
    assert done.code == 2
    said = "data.between_rows.u: inputs that are held, but the run was fitted to inputs that move between rows. Give linear"
    assert said in done.err


def test_rows_that_do_not_follow_each_other_have_no_next_value(folder: Path) -> None:
    words = ("fit", "--config-dir", "my", "sim=cart", "data=rig", *FEW, "data.layout=transitions", "data.episode=null")
    done = simpel(folder, *words, "data.between_rows={u: linear}", "hydra.run.dir=none")
    assert done.code == 2
    assert "data.between_rows: u is linear, but the next value of an input is not known" in done.err
    assert "set data.between_rows={u: held}" in done.err


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"between_rows": {"u": "lineal"}}, "data.between_rows.u: 'lineal' is not allowed, only held or linear or smooth. Did"),
        ({"noise": {"law": "cauchy"}}, "data.noise.law: 'cauchy' is not allowed, only auto or gaussian or student_t"),
        ({"noise": {"laww": "auto"}}, "data.noise.laww: no such key, only law or scale. Did you mean law"),
        ({"split": {"column": "part", "test": "slow"}}, "data.split.test: 'slow' is not a list of values"),
        ({"split": {"test": ["slow"]}}, "data.split: .* is not allowed"),
    ],
)  # fmt: skip
def test_wrong_keys_are_named(keys: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Measurements(path="run.csv", **keys)


@pytest.mark.parametrize("word", ["linear", "smooth"])
def test_a_black_box_holds_its_inputs(word: str) -> None:
    declared = Declared(
        {}, {"sim": SimpleNamespace(name="box"), "data": Measurements(path="run.csv", between_rows={"u": word})}
    )
    with pytest.raises(ConfigError, match=rf"data.between_rows.u: {word}, but box is asked for single transitions"):
        _ = declared.source


def test_a_state_is_no_input() -> None:
    config = Measurements(path="run.csv", between_rows={"s": "linear"})
    with pytest.raises(ConfigError, match=r"data.between_rows.s: the simulator has no such input \(it has: u\)"):
        config.check_names(NAMES, NAMES[:2])
