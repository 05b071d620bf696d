"""Composition and launch: the words of a command line become jobs, each with one resolved configuration.

Hydra composes and starts; it stays behind this room, whose callers see plain dictionaries.
"""

import contextlib
import os
import secrets
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from simpel_cli.config.build import of_group
from simpel_cli.config.folders import conf_dir, example_data_dir, recordings_dir, require_recordings
from simpel_cli.config.group_classes import SIMULATORS
from simpel_cli.config.groups import BROUGHT, CONTROL, group_folder, keys_of_other_verbs, top_level, user_conf
from simpel_cli.config.hydra_errors import translated, unknown_root
from simpel_cli.config.overrides import checked, swept_keys, value_of
from simpel_cli.config.places import Layer, layers_of, with_place
from simpel_cli.errors import ConfigError
from simpel_cli.runs.directory import refuse_occupied
from simulators.quantity import ModelError
from simulators.table_files import with_files_read


class Job(typing.NamedTuple):
    """One composed, resolved configuration."""

    config: dict[str, Any]
    directory: Path
    data_folder: Path  # folder of the data YAML: relative paths of measurements start there
    words: str = ""  # the overrides that tell this job from the others of a sweep
    given: tuple[str, ...] = ()  # all overrides, as typed
    verb: str = "fit"
    sweep: Path | None = None  # directory of the sweep that it is a job of
    launcher: dict[str, Any] = {}  # noqa: RUF012  options of the sweep's launcher
    layers: tuple[Layer, ...] = ()  # of a sweep's job: the YAML files that it is composed of


class _Stopped(BaseException):
    """Carries what a task raised past Hydra, which would print a line of its own and go on with a multirun."""


def launch(
    verb: str, task: Callable[[Job], Any], overrides: list[str], *, config_dir: Path | None, flags: Sequence[str] = ()
) -> None:
    """Compose `conf/<verb>.yaml` with overrides and run `task`; multirun, `--cfg job` and launchers are Hydra's.

    Args:
        verb: name of the root config.
        task: called with every composed job.
        overrides: `key=value` words. A dotted key may add what YAML leaves out: the dataclasses are the schema.
        config_dir: folder with the user's own groups (`sim/`, `data/`, ...), or one that has them under `conf/`.
        flags: flags for Hydra, e.g. `--cfg job` or `-m`.

    Raises:
        ConfigError: what the user wrote does not compose.
    """
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from simpel_cli.config import hydra_launcher as launcher

    words = checked(_appended(verb, overrides))
    user = user_conf(config_dir)
    if "--cfg" not in flags:
        _refuse_other_runs(overrides)
    register_resolvers()
    launcher.register()
    known, swept = top_level(verb), swept_keys(overrides)
    typed = {word.lstrip("+~").partition("=")[0].partition(".")[0] for word in overrides}

    def entry(config: Any) -> Any:
        if not OmegaConf.has_resolver("run_id"):  # a launcher has carried this to another process
            register_resolvers()
        try:
            hydra_config = HydraConfig.get()
            plain = typing.cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
            for key in [k for k in plain if k not in known]:
                if key not in keys_of_other_verbs(verb) or key in typed:
                    raise ConfigError(unknown_root(str(key), verb, known))
                del plain[key]
            folder = group_folder("data", hydra_config.runtime.choices.get("data"), user)
            _read_tables(plain, hydra_config.runtime.choices, user)
            require_recordings(plain.get("data"))
            directory = Path(hydra_config.runtime.output_dir)
            if config_dir is not None and "choices" in plain:
                plain["choices"]["config_dir"] = str(config_dir)  # for the commands that a run ends with
            given = [w.removeprefix("++") for w in hydra_config.overrides.task]
            chosen = " ".join(w for w in given if w.partition("=")[0] in swept)
            sweep = launching = None
            if hydra_config.mode is not None and hydra_config.mode.name == "MULTIRUN":
                sweep = Path(hydra_config.sweep.dir).absolute()
                launching = {k: v for k, v in (hydra_config.launcher or {}).items() if k != "_target_"}
            return task(
                Job(
                    plain,
                    directory,
                    folder,
                    chosen,
                    tuple(given),
                    "fit" if verb == "sweep" else verb,
                    sweep,
                    launching or {},
                    composed() if sweep else (),
                )
            )
        except Exception as error:
            layers.extend(composed())
            raise _Stopped from error

    def composed() -> tuple[Layer, ...]:
        with contextlib.suppress(Exception):  # where a key stands is no reason to lose what is wrong with it
            hydra_config = HydraConfig.get()
            choices = str(hydra_config.runtime.choices)
            if choices not in files:  # jobs of a sweep differ in numbers mostly, seldom in files
                files[choices] = tuple(layers_of(verb, hydra_config.overrides.task, folders))
            return files[choices]
        return ()

    layers: list[Layer] = []
    files: dict[str, tuple[Layer, ...]] = {}
    folders = [*([user] if user else []), conf_dir()]
    failure: BaseException | None = None
    before, sys.argv = sys.argv, [verb, *words, *flags, *(["--config-dir", str(user)] if user else [])]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors reach us as exceptions, not as Hydra's printout
    try:
        with _mode_of_flags() if value_of("hydra.mode", overrides) is None else contextlib.nullcontext():
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=verb)(entry)()
    except _Stopped as stopped:
        failure = translated(stopped.__cause__, verb, known, folders, own=False)
    except Exception as error:
        failure = translated(error, verb, known, folders, own=True)
    finally:
        sys.argv = before
    if failure is not None:  # raised here, so that no traceback shows our detour
        raise with_place(failure, layers, overrides)


def _read_tables(config: dict[str, Any], choices: Mapping[str, Any], user: Path | None) -> None:
    """Put the numbers of tables in place of their files, so that the configuration needs nothing beside it."""
    for key in (key for key in SIMULATORS if isinstance(config.get(key), dict)):
        chosen = choices.get("sim" if key == "sim" else f"sim@{key}")
        folders = [group_folder("sim", chosen, user), group_folder("experiment", choices.get("experiment"), user)]
        try:
            config[key] = with_files_read(config[key], [*folders, Path.cwd()])
        except ModelError as error:
            raise ConfigError(of_group(str(error), key)) from error


@contextlib.contextmanager
def _mode_of_flags() -> Iterator[None]:
    """Hydra composes everything twice, first for `hydra.mode` alone: 0.3 s of every start. Flags say it as well."""
    from hydra._internal.hydra import Hydra

    before = Hydra.get_mode
    Hydra.get_mode = lambda *_, **__: None
    try:
        yield
    finally:
        Hydra.get_mode = before


def sweep_directory() -> Path | None:
    """Return the directory of the multirun that this process has started last."""
    from simpel_cli.config import hydra_launcher as launcher

    return launcher.directories[-1] if launcher.directories else None


def register_resolvers() -> None:
    """Make `${simpel_data:}`, `${simpel_shared:}` (measurements) and `${run_id:}` (a new hash per launch) available."""
    from omegaconf import OmegaConf

    run_id = secrets.token_hex(3)  # two starts in one second must never share a run directory

    OmegaConf.register_new_resolver("simpel_data", lambda: str(example_data_dir()), replace=True)
    OmegaConf.register_new_resolver("simpel_shared", lambda: str(recordings_dir()), replace=True)
    OmegaConf.register_new_resolver("run_id", lambda: run_id, replace=True)


def _appended(verb: str, overrides: list[str]) -> list[str]:
    """Say `+group=` for a group that an experiment would bring, where there is none to bring it."""
    if verb not in CONTROL or any(word.startswith("experiment=") for word in overrides):
        return overrides
    return [f"+{word}" if word.partition("=")[0] in BROUGHT else word for word in overrides]


def _refuse_other_runs(overrides: list[str]) -> None:
    """Look into a run directory that the user names before Hydra writes to it."""
    if (given := value_of("hydra.run.dir", overrides)) is not None:
        refuse_occupied(Path(given))
