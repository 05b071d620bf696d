"""Units of what effects add, worked out from those of a model by cancelling powers of base words."""

import re
from collections.abc import Mapping


def unit_in(text: str, units: Mapping[str, str]) -> str:
    """Work out a unit written in scales, `A/V`, in the units of the model: powers of base words are cancelled."""
    powers: dict[str, int] = {}
    for sign, factor in re.findall(r"([*/]?)\s*([^*/]+)", text):
        base, _, exponent = factor.strip().partition("^")
        power = (-1 if sign == "/" else 1) * int(exponent or 1)
        _collect(units.get(base, base), power, powers)
    return _written(powers)


def per(unit: str, other: str) -> str:
    """Return the unit of a quotient, e.g. `rad/s^2` for rad/s over s."""
    powers: dict[str, int] = {}
    _collect(unit, 1, powers)
    _collect(other, -1, powers)
    return _written(powers)


def _collect(unit: str, power: int, powers: dict[str, int]) -> None:
    upper, *lower = unit.replace("(", "").replace(")", "").split("/")
    for part, sign in ((upper, 1), *((p, -1) for p in lower)):
        for word in part.split():
            base, _, exponent = word.partition("^")
            if base not in ("", "1", "-"):
                powers[base] = powers.get(base, 0) + sign * power * int(exponent or 1)


def _written(powers: Mapping[str, int]) -> str:
    def words(sign: int) -> str:
        return " ".join(b + (f"^{abs(n)}" if abs(n) > 1 else "") for b, n in powers.items() if n * sign > 0)

    upper, lower = words(1) or "1", words(-1)
    return f"{upper}/{lower}" if lower and " " not in lower else f"{upper}/({lower})" if lower else upper
