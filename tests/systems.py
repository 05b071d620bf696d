"""The simulators of conf/sim as tests need them."""

from pathlib import Path
from typing import Any

import yaml

from simulators.model import Declared, Model

SIMS = Path(__file__).parents[1] / "conf" / "sim"
SYMBOLIC = sorted(p.stem for p in SIMS.glob("*.yaml") if "_target_: simulators.worlds" not in p.read_text())


def node(name: str) -> dict[str, Any]:
    """Fields of a declared simulator."""
    content = yaml.safe_load((SIMS / f"{name}.yaml").read_text())
    assert content.pop("_target_") == "simulators.model.Declared"
    return content


def model(name: str, **known: float) -> Model:
    """The model of a file; parameters in `known` become numbers."""
    content = node(name)
    content["parameters"] |= known
    return Declared(**content).model()
