"""`build`: the dataclass that a config node declares, the fence around `_target_`, and what is refused with which words."""

import dataclasses
from dataclasses import dataclass

import pytest

from simpel_cli.config.build import build, build_groups
from simpel_cli.config.group_classes import OPTIONAL
from simpel_cli.errors import ConfigError
from simpel_cli.runs.settings import Settings


@dataclass(frozen=True)
class Inner:
    """A part.

    Args:
        width: of it, m.
    """

    width: float = 1.0


@dataclass(frozen=True)
class Outer:
    """A whole.

    Args:
        count: how many,
            over two lines.
        sizes: one per layer.
        inner: its part.
        label: what to call it; null = nothing.
    """

    count: int
    sizes: tuple[int, ...] = (1, 2)
    inner: Inner = Inner()
    label: str | None = None
    table: dict[str, float] = dataclasses.field(default_factory=dict)
    flag: bool = False

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError("outer.count: negative")


def make(**node: object) -> Outer:
    return build(node, "outer", default=Outer)


class TestBuild:
    def test_nested_dataclasses_lists_and_numbers(self) -> None:
        made = make(count=2, sizes=[3, 4], inner={"width": 2}, table={"a": 1}, label="x")
        assert made == Outer(2, (3, 4), Inner(2.0), "x", {"a": 1.0})
        assert isinstance(made.inner.width, float)
        assert isinstance(made.table["a"], float)

    def test_null_where_it_is_allowed(self) -> None:
        assert make(count=1, label=None).label is None

    @pytest.mark.parametrize(
        ("node", "message"),
        [
            ({"cout": 1}, r"outer\.cout: no such key in Outer\. Did you mean outer\.count\?.*how many, over two lines"),
            ({"zzz": 1}, r"outer\.zzz: no such key in Outer\. It has: count, sizes, inner, label, table, flag"),
            ({}, r"outer\.count: missing\. \(count: int, how many, over two lines\.\)"),
            ({"count": "a"}, r"outer\.count: got 'a'; expected an integer: how many"),
            ({"count": True}, r"outer\.count: got True; expected an integer"),
            ({"count": 1.0}, r"outer\.count: got 1\.0; expected an integer"),
            ({"count": None}, r"outer\.count: got None; expected an integer"),
            ({"count": 1, "sizes": 3}, r"outer\.sizes: got 3; expected a list of an integer: one per layer"),
            ({"count": 1, "sizes": [1, "b"]}, r"outer\.sizes\[1\]: got 'b'; expected an integer"),
            ({"count": 1, "inner": {"widht": 1}}, r"outer\.inner\.widht: .*Did you mean outer\.inner\.width\?"),
            ({"count": 1, "inner": {"width": "w"}}, r"outer\.inner\.width: got 'w'; expected a number: of it, m"),
            ({"count": 1, "inner": 3}, r"outer\.inner: got 3; expected a mapping of keys"),
            ({"count": 1, "table": {"a": "b"}}, r"outer\.table\.a: got 'b'; expected a number"),
            ({"count": 1, "table": [1]}, r"outer\.table: got \[1\]; expected a mapping"),
            ({"count": 1, "label": 3}, r"outer\.label: got 3; expected text or null"),
            ({"count": 1, "flag": "yes"}, r"outer\.flag: got 'yes'; expected true or false"),
            ({"count": -1}, r"outer\.count: negative"),
        ],
    )
    def test_messages(self, node: dict, message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            make(**node)

    def test_not_a_mapping(self) -> None:
        with pytest.raises(ConfigError, match=r"outer: got \[1\]; expected a mapping"):
            build([1], "outer", default=Outer)

    @pytest.mark.parametrize(
        "target",
        [
            "os.system",
            "builtins.eval",
            "pandas.read_pickle",
            "subprocess.Popen",
            "hydra.utils.instantiate",
            "command_line.Result",
        ],
    )
    def test_fence(self, target: str) -> None:
        with pytest.raises(ConfigError, match=r"allowed are classes of simpel_cli, simulators\. .*run\.plugins="):
            build({"_target_": target}, "x")

    @pytest.mark.parametrize(
        "target",
        [
            "simpel_cli.config.build.importlib.import_module",
            "simulators.model.casadi.SX",
            "simpel_cli.runs.lock.os.system",
        ],
    )
    def test_fence_holds_for_what_a_module_imports(self, target: str) -> None:
        with pytest.raises(ConfigError, match=r"cannot import|is not a dataclass"):
            build({"_target_": target}, "x")

    def test_plugins_open_the_fence(self) -> None:
        made = build({"_target_": f"{__name__}.Inner", "width": 3}, "x", (__name__,))
        assert made.width == 3.0

    def test_role_of_a_group(self) -> None:
        with pytest.raises(
            ConfigError, match=r"sim\._target_: simpel_cli\.priors\.gaussian_process\.Matern32 is no sim"
        ):
            build({"_target_": "simpel_cli.priors.gaussian_process.Matern32"}, "sim")


@pytest.mark.parametrize(
    ("path", "target"),
    [("sim", "simulators.built.Built"), ("method", "simpel_cli.methods.function_space.FunctionSpace")],
)
def test_a_base_of_others_is_named_as_such(path: str, target: str) -> None:
    with pytest.raises(ConfigError, match=rf"{path}\._target_: {target} is a base of others, .* as conf/{path}/ does"):
        build({"_target_": target, "name": "x", "dt": 1}, path)


class TestGroups:
    @pytest.mark.parametrize("group", ["sim", "data", "prior", "score", "method", "policy", "simulation"])
    def test_a_group_that_is_needed_is_not_null(self, group: str) -> None:
        with pytest.raises(ConfigError, match=rf"{group}: got None; expected a mapping of keys"):
            build_groups({group: None}, Settings())

    @pytest.mark.parametrize("node", [None, {}])
    def test_an_optional_group_may_be_null_or_empty(self, node: object) -> None:
        assert build_groups(dict.fromkeys(OPTIONAL, node), Settings()) == {"run": Settings()} | dict.fromkeys(OPTIONAL)

    def test_a_mujoco_world_is_made_where_it_is_acted_in(self) -> None:
        node = {"name": "car", "xml": "nowhere.xml"}
        assert build_groups({"mujoco": node, "world": "sim"}, Settings())["mujoco"] is None
        with pytest.raises(ConfigError, match="mujoco"):
            build_groups({"mujoco": node, "world": "mujoco"}, Settings())

    def test_an_effect_without_its_name(self) -> None:
        with pytest.raises(ConfigError, match=r"effect\.acts_on: got 'velocity'; expected a mapping of keys"):
            build_groups({"effect": {"acts_on": "velocity"}}, Settings())

    def test_a_class_that_is_missing_in_a_part(self) -> None:
        node = {"_target_": "simpel_cli.priors.function_prior.GPPrior", "kernel": {}}
        with pytest.raises(
            ConfigError, match=r"prior\.kernel: the key _target_ is missing; .* options in conf/prior/ do"
        ):
            build_groups({"prior": node}, Settings())
