"""The simulators of conf/sim as tests need them."""

from pathlib import Path
from typing import Any

import yaml

from simpel_cli.config.build import build
from simulators.model import Declared, Model

SIMS = Path(__file__).parents[1] / "conf" / "sim"
SYMBOLIC = sorted(p.stem for p in SIMS.glob("*.yaml") if "_target_: simulators.worlds" not in p.read_text())


CART = Declared(
    name="cart", dt=0.1,
    states={"s": {"unit": "m", "range": [-10, 10]}, "v": {"unit": "m/s", "range": [-5, 5]}},
    inputs={"u": {"unit": "V", "range": [-2, 2]}},
    dynamics={"s": "v", "v": "u - v"},
    outputs={"force": {"unit": "N", "expression": "-v"}},
).model()  # fmt: skip


def node(name: str) -> dict[str, Any]:
    """Fields of a declared simulator."""
    content = whole_node(name)
    assert content.pop("_target_", "simulators.model.Declared") == "simulators.model.Declared"
    return content


def whole_node(name: str) -> dict[str, Any]:
    """Node of a simulator, with its `_target_`."""
    content: dict[str, Any] = yaml.safe_load((SIMS / f"{name}.yaml").read_text())
    return content


def model(name: str, **known: float) -> Model:
    """The model of a file; parameters in `known` become numbers."""
    content = whole_node(name)
    if known:
        content["parameters"] = content["parameters"] | known
    built = build(content, "sim").model()
    assert isinstance(built, Model)
    return built
