"""What a user can cause, with the exit code that a script sees.

A message names the key or file, what was given, what is allowed and the cure.
"""

from collections.abc import Sequence


class SimpelError(Exception):
    """Base of every error that is shown as one message without a traceback."""

    exit_code = 1


class ConfigError(SimpelError):
    """Usage or configuration: a key, a value, a YAML file."""

    exit_code = 2


class DataError(SimpelError):
    """Measurements: a file, column, row or unit."""

    exit_code = 3


class NumericsError(SimpelError):
    """A computation went non-finite; names the step, the quantity and the last good checkpoint."""

    exit_code = 4


class Inconclusive(SimpelError):  # noqa: N818 (an answer, not a fault)
    """`discover --strict` with a verdict other than `effect`."""

    exit_code = 5


class Interrupted(SimpelError):  # noqa: N818 (a state that was saved, not a fault)
    """Ctrl-C or SIGTERM; the state is saved."""

    exit_code = 130


def did_you_mean(word: object, allowed: Sequence[object]) -> str:
    """Return `" Did you mean X?"` for a near miss of `word` in `allowed`, else an empty string."""
    from difflib import get_close_matches

    close = get_close_matches(
        str(word), [str(name) for name in allowed], n=1, cutoff=0.6
    )  # YAML reads 1e999 as a number
    return f" Did you mean {close[0]}?" if close else ""


def check_at_least_one(group: str, settings: object, names: tuple[str, ...]) -> None:
    """Refuse fields of a configuration group that are below 1.

    Raises:
        ConfigError: with the key, what was given and what is allowed.
    """
    for name in names:
        if getattr(settings, name) < 1:
            raise ConfigError(f"{group}.{name}: got {getattr(settings, name)}; it must be at least 1.")
