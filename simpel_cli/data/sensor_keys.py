"""The key `sensor` of a data YAML: what a sensor can record."""

import math
from collections.abc import Mapping
from typing import Any

from simpel_cli.errors import ConfigError, did_you_mean

KEYS = ("saturates",)
SENSOR: dict[str, Any] = {  # JSON schema
    "type": "object",
    "additionalProperties": {
        "type": ["object", "null"],
        "properties": {
            "saturates": {
                "type": "array",
                "items": {"type": ["number", "null"]},
                "minItems": 2,
                "maxItems": 2,
                "description": "[low, high] that the sensor records, in the quantity's unit; null: no end.",
            }
        },
        "additionalProperties": False,
    },
}


def read_sensor(given: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Read `data.sensor`: the lowest and the highest value of every sensor, infinite where there is no end.

    Raises:
        ConfigError: an unknown key, no two numbers, or ends in the wrong order.
    """
    found: dict[str, tuple[float, float]] = {}
    for name, node in given.items():
        path = f"data.sensor.{name}"
        if node is None:  # how a sensor of the YAML is taken away on the command line
            continue
        if not isinstance(node, Mapping):
            raise ConfigError(f"{path}: {node!r} is not allowed, only e.g. {{saturates: [0, 10]}}.")
        for key in node:
            if key not in KEYS:
                raise ConfigError(f"{path}.{key}: no such key, only saturates.{did_you_mean(str(key), list(KEYS))}")
        if "saturates" not in node:
            continue
        ends = node["saturates"]
        if not (isinstance(ends, list | tuple) and len(ends) == 2 and all(map(_is_end, ends))):
            raise ConfigError(
                f"{path}.saturates: {ends!r} is not allowed, only [low, high] in the unit of {name}, null where there is no "
                "end, e.g. [0, null]."
            )
        low, high = (end if at is None else float(at) for at, end in zip(ends, (-math.inf, math.inf), strict=True))
        if low >= high:
            raise ConfigError(
                f"{path}.saturates: [{low:g}, {high:g}] is no range: its low end is not below its high end. Write [low, high]."
            )
        found[name] = (low, high)
    return found


def _is_end(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value))
