"""Hydra's launcher `dask`: it composes the jobs of a sweep one by one, and whoever takes them runs them meanwhile."""

import importlib.util
import sys
import types
from pathlib import Path
from typing import Any, ClassVar

from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.plugins import Plugins
from hydra.experimental.callback import Callback

directories: list[Path] = []  # of the multiruns that this process has started


class DaskLauncher(BasicLauncher):
    """Hands every job to the task function as soon as it is composed. The task function queues it and returns.

    Args:
        options: of the cluster, see `conf/hydra/launcher/dask.yaml`; jobs carry them to `sweeps.workers`.
    """

    chosen: ClassVar[bool] = False  # by the multirun of this process: options of a user's own may have any name
    queue: ClassVar[Any] = None  # of that multirun: takes its jobs

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.options = options

    def setup(self, **hydra: Any) -> None:
        """Hydra has chosen it."""
        super().setup(**hydra)
        DaskLauncher.chosen = True


# Hydra takes plug-ins from modules of the namespace `hydra_plugins` only: this module is one of them under another name
DaskLauncher.__module__ = "hydra_plugins.simpel"


class Directory(Callback):
    """Notes the directory of a multirun, whatever its launcher; named in `conf/fit.yaml`."""

    def on_multirun_start(self, config: Any, **more: Any) -> None:
        """Note it."""
        directories.append(Path(config.hydra.sweep.dir).absolute())


def register() -> None:
    """Make the launcher known to Hydra."""
    if (
        "hydra_plugins" not in sys.modules and importlib.util.find_spec("hydra_plugins") is None
    ):  # no other is installed
        sys.modules["hydra_plugins"] = types.ModuleType("hydra_plugins")
        sys.modules["hydra_plugins"].__path__ = []
    vars(importlib.import_module("hydra_plugins"))["simpel"] = sys.modules[__name__]
    sys.modules["hydra_plugins.simpel"] = sys.modules[__name__]
    Plugins.instance().register(DaskLauncher)
