"""Words of a command line, `key=value`: checked, read, counted."""

import math
import re

from simpel_cli.errors import ConfigError


def count_jobs(overrides: list[str]) -> int:
    """Return the number of jobs of a multirun.

    Raises:
        ConfigError: an override is not of the form key=value.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(checked(overrides))
    return math.prod(sum(1 for _ in o.sweep_iterator()) for o in parsed if o.is_sweep_override())


def first_job(overrides: list[str]) -> list[str]:
    """Return the overrides of the first job of a multirun."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(checked(overrides))
    return [
        f"{o.get_key_element()}={next(iter(o.sweep_string_iterator()))}" if o.is_sweep_override() else word
        for word, o in zip(overrides, parsed, strict=True)
    ]


def value_of(key: str, overrides: list[str]) -> str | None:
    """Return the text that the last override of a key gives it; None: there is none."""
    found = [re.fullmatch(rf"\+*{re.escape(key)}=(['\"]?)(.*)\1", word) for word in overrides]
    return next((match[2] for match in reversed(found) if match), None)


def swept_keys(overrides: list[str]) -> set[str]:
    """Return the keys to which a multirun gives several values."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(checked(overrides))
    return {o.key_or_group for o in parsed if o.is_sweep_override()}


def checked(overrides: list[str]) -> list[str]:
    """Return the overrides as Hydra takes them.

    Raises:
        ConfigError: one is not of the form key=value.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    words = [_force(o) for o in overrides]
    for given, word in zip(overrides, words, strict=True):
        key, sign, value = given.partition("=")
        if not given.startswith("~") and (not sign or not key or key != key.strip() or value != value.lstrip()):
            raise ConfigError(
                f"{given}: not of the form key=value, without blanks around the sign, e.g. method.steps=2000 or "
                "method=fsvgd."
            )
        try:
            OverridesParser.create().parse_override(word)
        except HydraException as error:
            raise ConfigError(
                f"{given}: the value cannot be read. A list is written [1,2]; text with brackets, commas or quotes "
                f"goes into quotes of its own, twice because of the shell: '{key}=\"{value}\"'."
            ) from error
    return words


def _force(override: str) -> str:
    """Let `a.b=c` set what the YAML leaves out; `config.build` then tells a field from a typo."""
    return f"++{override}" if re.match(r"(?!hydra\.)[A-Za-z_]\w*(\.[\w\[\]]+)+=", override) else override
