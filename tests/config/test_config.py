"""Configuration: every YAML of conf/ composes and builds and lists what can be set; words of the command line."""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

import pytest
import yaml
from command_line import ROOT, simpel
from omegaconf import OmegaConf

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.config.overrides import checked, count_jobs
from simpel_cli.data import Measurements
from simpel_cli.evaluation.settings import Evaluation
from simpel_cli.inference.networks import MLP
from simpel_cli.runs.settings import Settings
from simulators.built import Built
from simulators.model import Model
from simulators.worlds.simulate import Simulate
from simulators.worlds.world import World

CONF = ROOT / "conf"
DEFAULTS = {"data": Measurements, "run": Settings, "evaluation": Evaluation, "simulation": Simulate}
GROUPS = ("sim", "data", "prior", "score", "method", "evaluation", "simulation", "run")


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def compose(folder: Path, verb: str, *words: str) -> dict:
    """Compose as `--cfg job` does, with interpolations in place."""
    result = simpel(folder, verb, *words, "--cfg", "job")
    assert result.code == 0, result.err
    return yaml.safe_load(result.out)


def resolved(node: dict) -> dict:
    return OmegaConf.to_container(OmegaConf.create(node), resolve=True)


def test_conf_is_the_checkouts() -> None:
    assert conf_dir() == CONF


@pytest.mark.parametrize(("group", "option"), [(g, o) for g in GROUPS for o in options(g)])
def test_every_option_composes_and_builds(group: str, option: str, tmp_path: Path) -> None:
    verb = "simulate" if group == "simulation" else "fit"
    config = compose(tmp_path, verb, *([] if group in ("run", "evaluation") else [f"{group}={option}"]))
    if group == "run":  # its name is taken from the simulator
        config["run"]["name"] = "x"
    if group == "method":  # a choice of the control group, where there is one
        config["method"] = resolved(config["method"])
    built = build(config[group], group, default=DEFAULTS.get(group))
    if group == "sim":
        source = built.model()
        assert isinstance(source, Model | World)
        assert source.name == option
    if group == "method":  # a method chooses its prior
        build(config["prior"], "prior")


@pytest.mark.parametrize("experiment", options("experiment"))
def test_every_experiment_composes_and_builds(experiment: str, tmp_path: Path) -> None:
    path = CONF / "experiment" / f"{experiment}.yaml"
    lines = path.read_text().splitlines()
    assert lines[0] == "# @package _global_"
    assert re.match(rf"# simpel [\w-]+ experiment={experiment}\b", lines[1]), "the second line is the command"
    verb = lines[1].split()[2]
    config = compose(tmp_path, verb, f"experiment={experiment}")
    assert config["run"]["name"] == experiment
    config["method"] = resolved(config)["method"]
    for group in GROUPS:
        if group in config:
            build(config[group], group, default=DEFAULTS.get(group))


def test_an_experiment_serves_every_verb(tmp_path: Path) -> None:
    (tmp_path / "my" / "experiment").mkdir(parents=True)
    text = "# @package _global_\nrun: {name: mine}\nclose: false\ndiscovery: {rows: 7}\n"
    (tmp_path / "my" / "experiment" / "mine.yaml").write_text(text)
    words = ("--config-dir", "my", "experiment=mine")
    searched = compose(tmp_path, "discover", *words)
    assert (searched["close"], searched["discovery"]["rows"]) == (False, 7)
    assert compose(tmp_path, "discover", *words, "close=true")["close"] is True
    result = simpel(tmp_path, "fit", *words, "data.n_train=-1")  # that far and no further: its own mistake is told
    assert "data.n_train" in result.err
    result = simpel(tmp_path, "fit", *words, "+discovery.lanes=3")
    assert "discovery: no such key or group of `simpel fit`" in result.err


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda p: str(p.relative_to(CONF)))
def test_every_yaml_says_what_it_is(path: Path) -> None:
    assert path.read_text().startswith("# "), "the first line is a comment that says what the file is"


# Fields that are a system's own: a YAML of a system names those that it has.
OWN_TO_THE_SYSTEM = {"Declared", "MujocoWorld", "CallableWorld", "Measurements"}


@pytest.mark.parametrize(
    "path",
    [p for g in (*GROUPS, "experiment") for p in sorted((CONF / g).glob("*.yaml")) if "_target_" in p.read_text()],
    ids=lambda p: str(p.relative_to(CONF)),
)
def test_leaves_list_every_field(path: Path) -> None:
    """What can be set stands in the YAML with its value: users read it there."""
    from simpel_cli.config.build import resolve

    def check(node: Mapping, where: str) -> None:
        if "_target_" in node:
            cls = resolve(node["_target_"], where, ())
            names = {f.name for f in dataclasses.fields(cls)}
            written = set(node) - {"_target_", "defaults"}
            assert written <= names
            if issubclass(cls, Built):  # its equations are in Python
                names -= {"dynamics", "outputs", "intermediates", "tables"}
            if cls.__name__ not in OWN_TO_THE_SYSTEM:
                left_out = names - written - {"sensors"}  # of which most simulators have none
                assert not left_out, f"{where}: {left_out} left out"
        for key, value in node.items():
            if isinstance(value, Mapping):
                check(value, f"{where}.{key}")

    check(yaml.safe_load(path.read_text()), path.stem)


def test_run_and_evaluation_list_every_field() -> None:
    for group, cls in (("run", Settings), ("evaluation", Evaluation)):
        written = yaml.safe_load((CONF / group / "default.yaml").read_text())
        assert set(written) == {f.name for f in dataclasses.fields(cls)}


class TestValuesInYamlAreTheDefaults:
    """The dataclass and the YAML that shows it do not drift apart."""

    @pytest.mark.parametrize(
        ("group", "option"),
        [("method", "simpel"), ("prior", "simulator"), ("score", "gaussian"), ("simulation", "default")],
    )
    def test_default(self, group: str, option: str) -> None:
        node = resolved(yaml.safe_load((CONF / group / f"{option}.yaml").read_text()))
        node.pop("defaults", None)
        built = build(node, group)
        assert built == type(built)()

    def test_all_methods_have_the_same_networks(self) -> None:
        """A comparison of methods is none of networks. What an older run says of its network, without an activation, stays."""
        found = []
        for path in sorted((CONF / "method").glob("*.yaml")):
            node = resolved(yaml.safe_load(path.read_text()))
            built = build({k: v for k, v in node.items() if k != "defaults"}, "method")
            built = getattr(built, "residual", built)
            found += [built.network] if hasattr(built, "network") else []
        assert len(found) > 8
        assert set(found) == {MLP((64, 64, 64), 0.01, "silu")}
        older = {"_target_": "simpel_cli.methods.fsvgd.FSVGD", "network": {"hidden": [8], "negative_slope": 0.2}}
        assert build(older, "method").network == MLP((8,), 0.2, "leaky_relu")


class TestOverrides:
    def test_a_dotted_key_may_add(self) -> None:
        assert checked(["method.steps=3", "method=fsvgd", "hydra.run.dir=x", "~a.b", "+c.d=1"]) == [
            "++method.steps=3", "method=fsvgd", "hydra.run.dir=x", "~a.b", "+c.d=1",
        ]  # fmt: skip

    @pytest.mark.parametrize(
        ("words", "jobs"),
        [(["a=1"], 1), (["a=1,2,3"], 3), (["a=1,2", "b.c=x,y,z"], 6), (["run.seed=range(5)"], 5), (["a.b=[1,2]"], 1)],
    )
    def test_number_of_jobs(self, words: list[str], jobs: int) -> None:
        assert count_jobs(words) == jobs

    def test_expressions(self, tmp_path: Path) -> None:
        config = compose(tmp_path, "fit", 'sim.dynamics.omega="(m*g)/I"', "sim.parameters.I=m*l**2")
        assert config["sim"]["dynamics"]["omega"] == "(m*g)/I"
        assert config["sim"]["parameters"]["I"] == "m*l**2"
