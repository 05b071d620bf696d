"""Words for units: one spelling of each, and whether a text is a unit at all."""

import re

ALIASES = {
    "-": "1", "none": "1", "dimensionless": "1",
    "radian": "rad", "radians": "rad", "degree": "deg", "degrees": "deg", "°": "deg",
    "sec": "s", "second": "s", "seconds": "s", "meter": "m", "metre": "m", "meters": "m", "metres": "m",
    "volt": "V", "volts": "V",
}  # fmt: skip
PREFIXES = ("da", *"QRYZEPTGMkhdcmµμunpfazyrq")
WITH_PREFIX = {
    "m", "s", "g", "A", "K", "mol", "cd", "rad", "Hz", "N", "Pa", "J", "W", "C", "V", "F", "Ω", "Ohm", "ohm", "S", "T", "H",
    "Wb", "lm", "lx", "Bq", "Gy", "bar", "L", "l", "eV", "Ah", "Wh", "VA", "var", "sec", "cal",
}  # fmt: skip
WITHOUT_PREFIX = {
    "1", "%", "‰", "ppm", "deg", "°", "°C", "°F", "degC", "degF", "celsius", "kelvin", "rpm", "rps", "rev", "U", "min", "h",
    "d", "hr", "hour", "hours", "day", "days", "minute", "minutes", "amp", "amps", "ampere", "amperes", "newton", "newtons",
    "inch", "ft", "yd", "mi", "mph", "kph", "kmh", "psi", "atm", "mmHg", "Torr", "lb", "lbs", "lbf", "kgf", "oz", "kn",
    "knots", "count", "counts", "tick", "ticks", "step", "steps", "px", "pixel", "pixels", "LSB", "bit", "bits", "dB", "dBm",
    "gal", "g0",
}  # fmt: skip
POWER = re.compile(r"\^?-?[1-9]$|[²³]$")
BRACKETS = {"[": "]", "(": ")"}


def canonical(unit: str) -> str:
    """One spelling per unit: `N*m/V` = `N m / V`, `m/s^2` = `m/s²`, `degrees` = `deg`; order stays as written."""
    text = unit.strip().replace("²", "2").replace("³", "3").replace("**", "").replace("^", "")
    words = [word for word in re.split(r"([/])|[\s*·]+", text) if word]
    return " ".join(ALIASES.get(word, ALIASES.get(word.lower(), word)) for word in words)


def is_unit(text: str) -> bool:
    """Whether a text is a product or quotient of known units, e.g. `N m/V`, `m/s^2`, `1/s`, `deg`, `-`."""
    text = text.strip()
    if text in ALIASES:
        return True
    if not text or len(text) > 40:
        return False
    plain = text.replace("**", "^").replace("(", "").replace(")", "")
    factors = re.split(r"\s*[/*·]\s*|\s+", plain)
    return all(_is_symbol(factor) for factor in factors)


def bare(text: str) -> str:
    """Return a unit without brackets around all of it: `[rad]` is `rad`."""
    text = text.strip()
    if len(text) > 2 and BRACKETS.get(text[0]) == text[-1] and text[0] not in text[1:]:
        return text[1:-1].strip()
    return text


def _is_symbol(word: str) -> bool:
    plain = POWER.sub("", word) if len(word) > 1 else word
    if plain in WITH_PREFIX or plain in WITHOUT_PREFIX or plain in ALIASES or plain.lower() in ALIASES:
        return True
    return any(plain.startswith(p) and plain.removeprefix(p) in WITH_PREFIX for p in PREFIXES)
