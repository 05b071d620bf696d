"""Every group of a configuration as an object, built once; what comes after assembles them and builds nothing again."""

from collections.abc import Collection
from dataclasses import replace
from typing import Any, NamedTuple

from simpel_cli.config.build import build_groups, build_settings
from simpel_cli.config.compose import Job
from simpel_cli.data import Measurements, absolute
from simpel_cli.data.recording import Source
from simpel_cli.errors import ConfigError
from simpel_cli.evaluation.settings import Evaluation
from simpel_cli.inference.protocols import Method
from simpel_cli.priors.function_prior import GPPrior, SimulatorPrior
from simpel_cli.runs.settings import Settings
from simulators.model import Model
from simulators.quantity import HELD


class Declared(NamedTuple):
    """A configuration, and its groups as objects.

    Args:
        config: resolved, as the run directory keeps it.
        groups: every group that the configuration has, by name; None where it is null.
    """

    config: dict[str, Any]
    groups: dict[str, Any]

    @property
    def settings(self) -> Settings:
        """The group `run`."""
        found: Settings = self.groups["run"]
        return found

    @property
    def source(self) -> Source:
        """The simulator, a symbolic model or a world with query access only.

        Data may say what inputs do between rows, and how late its outputs are recorded, in place of what it says itself;
        effects say which columns name groups.
        """
        found, data = self.groups["sim"], self.groups.get("data")
        said: dict[str, str] = dict(data.between_rows) if isinstance(data, Measurements) else {}
        if isinstance(found, Model):
            late = (
                data.latency_over(found.latency) if isinstance(data, Measurements) and data.latency else found.latency
            )
            return replace(found, between_rows=found.between_rows | said, latency=late, asked=self._columns_of_groups)
        moving = [name for name, word in said.items() if word != HELD]
        if moving:
            raise ConfigError(
                f"data.between_rows.{moving[0]}: {said[moving[0]]}, but {found.name} is asked for single transitions, over "
                "which it holds its inputs. Give held, or a simulator in symbols."
            )
        return found

    @property
    def _columns_of_groups(self) -> dict[str, str]:
        """Columns of groups that effects name, or the data where there are effects, each with the key that does."""
        effects, data = self.groups.get("effect") or (), self.groups.get("data")
        asked = data.groups if effects and isinstance(data, Measurements) else ()
        return dict.fromkeys(asked, "data.groups") | {e.per: f"effect.{e.name}.per" for e in effects if e.per}

    @property
    def measurements(self) -> Measurements:
        """The group `data`."""
        found: Measurements = self.groups["data"]
        return found

    @property
    def prior(self) -> SimulatorPrior | GPPrior:
        """The prior over functions."""
        found: SimulatorPrior | GPPrior = self.groups["prior"]
        return found

    @property
    def score(self) -> Any:
        """The score estimator."""
        return self.groups["score"]

    @property
    def method(self) -> Method:
        """The inference rule."""
        found: Method = self.groups["method"]
        return found

    @property
    def evaluation(self) -> Evaluation:
        """How a posterior is tested."""
        return self.groups.get("evaluation") or Evaluation()

    @property
    def choices(self) -> dict[str, Any]:
        """The option that was chosen of every group."""
        found: dict[str, Any] = self.config["choices"]
        return found

    def without(self, *names: str) -> "Declared":
        """Return the configuration without some groups and keys."""
        return self._replace(
            config={k: v for k, v in self.config.items() if k not in names},
            groups={k: v for k, v in self.groups.items() if k not in names},
        )

    def changed(self, **nodes: Any) -> "Declared":
        """Return the configuration with other nodes; only these are built.

        Raises:
            ConfigError: what a group's class refuses.
        """
        settings = build_settings(nodes) if "run" in nodes else self.settings
        return self._replace(config=self.config | nodes, groups=self.groups | build_groups(nodes, settings))


def declare(config: dict[str, Any], settings: Settings | None = None, only: Collection[str] | None = None) -> Declared:
    """Build every group of a resolved configuration: whatever is wrong in it is found before any file is read.

    Args:
        config: the configuration.
        settings: its group `run`, where it is built already.
        only: build these groups only; None: all of them.

    Raises:
        ConfigError: a key.
    """
    settings = settings or build_settings(config)
    asked = config if only is None else {name: node for name, node in config.items() if name in only}
    return Declared(config, build_groups(asked, settings))


def resolved(job: Job) -> dict[str, Any]:
    """Return the configuration as it is kept in the run directory: absolute path of the data, choices of groups."""
    config = dict(job.config)
    if isinstance(config.get("data"), dict):
        config["data"] = absolute(config["data"], job.data_folder)
    return config
