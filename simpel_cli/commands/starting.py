"""How a verb starts its work: composed by Hydra, once or for every combination, or resumed."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from simpel_cli.errors import ConfigError

if TYPE_CHECKING:
    from simpel_cli.config.compose import Job


def launch(
    verb: str,
    task: Callable[["Job"], None],
    overrides: list[str] | None,
    config_dir: Path | None,
    cfg: str | None,
    multirun: bool = False,
) -> None:
    """Compose the configuration of a verb and run its task, or a sweep of the verb.

    Args:
        verb: name of the root configuration.
        task: what it does with a job.
        overrides: as typed.
        config_dir: folder of the user's groups.
        cfg: what `--cfg` prints; None: the task runs.
        multirun: whether every combination of values is run.
    """
    if multirun:
        from simpel_cli.sweeps.sweep import sweep

        sweep(verb, overrides or [], config_dir, cfg)
        return
    from simpel_cli.config.compose import launch as compose

    compose(verb, task, overrides or [], config_dir=config_dir, flags=["--cfg", cfg] if cfg else [])


def refuse_more(resume: Path, *given: object) -> None:
    """Refuse words beside `--resume`.

    Raises:
        ConfigError: there are some.
    """
    if any(given):
        raise ConfigError(
            "--resume: a resumed run takes nothing else; its configuration is in "
            f"{resume / 'config.yaml'}. For other settings start a new run."
        )
