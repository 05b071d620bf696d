"""What Hydra and OmegaConf complain about, as a `ConfigError` of one line that names the key and the cure."""

import re
from pathlib import Path
from typing import Any

from simpel_cli.errors import ConfigError, did_you_mean


def translated(
    error: BaseException | None, verb: str, known: list[str], folders: list[Path], *, own: bool
) -> BaseException:
    """Return a `ConfigError` for what the user can have caused, anything else as it is.

    Args:
        error: what was raised.
        verb: that was launched.
        known: groups and keys of the verb.
        folders: where groups are looked for, the user's first.
        own: Hydra itself raised it, not the task.
    """
    import yaml
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    assert error is not None
    message = None
    if isinstance(error, OmegaConfBaseException | HydraException):
        message = _one_line(error, verb, known, folders)
    elif own and isinstance(error, yaml.YAMLError):
        message = _yaml_message(error)
    elif own and isinstance(error, UnicodeDecodeError):
        message = f"{_not_text(folders[0])}: not UTF-8 text ({error.reason}). Save it in UTF-8."
    elif own and isinstance(error, OSError) and error.filename:
        message = (
            f"hydra.run.dir: cannot write to {error.filename} ({error.strerror}). Choose another: hydra.run.dir=DIR."
        )
    elif own and isinstance(error, ValueError) and "Config group override must be" in str(error):
        groups = ", ".join(name for name in known if name != "choices")
        message = f"a group cannot be null: name one of its options, e.g. method=simpel (groups and keys: {groups})."
    elif own and isinstance(error, ValueError) and "integer string conversion" in str(error):
        message = "a YAML holds a number of thousands of digits; the largest that a computer has is about 1e308."
    elif own and isinstance(error, RecursionError):
        message = "a YAML refers to itself (an anchor inside what it names, e.g. &a [*a]); write out what is meant."
    if message is None:
        return error
    refusal = ConfigError(message)
    refusal.__cause__ = error
    return refusal


def unknown_root(key: str, verb: str, known: list[str]) -> str:
    """Say that a verb has no such group or key.

    Args:
        key: that was given.
        verb: that was launched.
        known: groups and keys of the verb.
    """
    if key == "experiment":
        return "experiment: its file must begin with the line `# @package _global_`, so that it can set every group."
    if key.startswith("hydra."):
        return f"{key}: no such key of Hydra's; `simpel {verb} --cfg hydra` shows them."
    shown = [name for name in known if name != "choices"]
    return f"{key}: no such key or group of `simpel {verb}`.{did_you_mean(key, shown)} (it has: {', '.join(shown)})"


def _extra(launcher: str) -> str:
    """Return how a launcher is installed that is an extra."""
    extra = next(
        (extra for word, extra in {"slurm": "slurm", "submitit": "slurm", "ray": "ray"}.items() if word in launcher), ""
    )
    names = {"slurm": "submitit_slurm and submitit_local", "ray": "ray"}
    return f" {names[extra]}: pip install 'simpel[{extra}]'." if extra else ""


def _one_line(error: Exception, verb: str, known: list[str], folders: list[Path]) -> str:
    """Say in one line what Hydra and OmegaConf say in ten."""
    text = str(error)
    cause = error.__cause__
    if found := re.search(r"Could not find '([\w/@.\-]+)/([^'/]*)'\s+Available options in '[^']*':\s*(.*)", text, re.S):
        group, choice, listing = found.groups()
        options = [o for o in listing.split() if o and not o.startswith("Config")]
        options = options[: options.index("search")] if "search" in options else options
        hint = "" if group != "hydra/launcher" else _extra(choice)
        return f"{group}: no option {choice!r}.{did_you_mean(choice, options)}{hint} (available: {', '.join(options)})"
    if found := re.search(r"Could not load '([\w/@.\-]+)/([^'/]*)'", text):  # an entry of a list of choices
        group, choice = found.groups()
        options = sorted({p.stem for folder in folders for p in (folder / group).glob("*.yaml")})
        return f"{group}: no option {choice!r}.{did_you_mean(choice, options)} (available: {', '.join(options)})"
    if found := re.search(r"Could not find '([^']+)'", text):
        return f"{found[1]}: no such configuration. Groups are folders with YAML files, given with --config-dir DIR."
    if found := re.search(r"Could not override '([\w.@/]+)'", text):
        return unknown_root(found[1], verb, known)
    if found := re.search(r"Ambiguous value for argument '\+*([^']*)'", text):
        key, _, value = found[1].partition("=")
        return (
            f"{found[1]}: several values, but `simpel {verb}` takes one. Run each of them with "
            f"`simpel sweep {found[1]}`; a list is written '{key}=[{value}]'."
        )
    lines = [line.strip() for line in [*str(cause or "").splitlines(), *text.splitlines()] if line.strip()]
    key = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("full_key:")), "")
    what = lines[0] if lines else text
    if "'sim.name' not found" in what or "Index 'name'" in what:
        return "sim.name: missing. A simulator's YAML is a mapping with the keys name, dt, states, dynamics, ..."
    return f"{key + ': ' if key else ''}{_interpolation(what, key)}"


def _interpolation(text: str, key: str) -> str:
    """Say what is wrong with a value that refers to another."""
    if found := re.search(r"Interpolation key '(.+)' not found", text):
        return f"${{{found[1]}}} names a key that does not exist. Write out the value, or the whole path of the key."
    if found := re.search(r"Environment variable '(.+)' not found", text):
        return f"the environment variable {found[1]} is not set: set it, or give a default, ${{oc.env:{found[1]},DEFAULT}}."
    if found := re.search(r"Unsupported interpolation type (.+)", text):
        known = "${oc.env:NAME}, ${simpel_data:}, ${simpel_shared:} and ${key}"
        return f"${{{found[1]}:...}} is unknown; allowed are {known}."
    if "Cannot merge" in text and "ListConfig" in text:
        return (
            "a list and a mapping cannot be merged. Take away what stands there, then give yours: "
            f"'~{key}' '+{key}=...'."
        )
    if "Missing mandatory value" in text:
        return f"a value must be given (the YAML says ???), e.g. on the command line: {key}=VALUE."
    if found := re.search(r"(?:no viable alternative|mismatched|token recognition).*?'(\$\{.*)'", text):
        return f"{found[1]!r} is no complete ${{...}}; close the brace."
    return text


def _yaml_message(error: Any) -> str:
    mark = getattr(error, "problem_mark", None)
    where = f"{mark.name}, line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return f"{where}not valid YAML ({getattr(error, 'problem', None) or error})."


def _not_text(user: Path) -> str:
    """First YAML file of the user's that is not UTF-8."""
    for path in sorted(user.rglob("*.yaml")):
        try:
            path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            return str(path)
    return "a YAML file"
