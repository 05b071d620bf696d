"""From a declared configuration to a study: the measurements are read, the simulator is bound to its coordinates."""

from pathlib import Path
from typing import Any, NamedTuple

from simpel_cli.data import Measurements, Recording, read
from simpel_cli.data.recording import Source
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.evaluation.settings import Evaluation
from simpel_cli.filtering import estimated_rows
from simpel_cli.inference.protocols import Method
from simpel_cli.inference.system import System, system_of
from simpel_cli.priors.function_prior import GPPrior, SimulatorPrior
from simpel_cli.runs.settings import Settings, configure
from simpel_cli.studies.declared import Declared
from simulators.groups import grouped
from simulators.model import Model, ModelError


class Study(NamedTuple):
    """A declared configuration with its measurements read.

    Args:
        declared: the configuration's objects.
        device: that computations run on.
        system: the simulator in the coordinates of learning.
        recording: the measurements.
    """

    declared: Declared
    device: Any
    system: System
    recording: Recording

    @property
    def settings(self) -> Settings:
        """The group `run`."""
        return self.declared.settings

    @property
    def measurements(self) -> Measurements:
        """The group `data`."""
        return self.declared.measurements

    @property
    def prior(self) -> SimulatorPrior | GPPrior:
        """The prior over functions."""
        return self.declared.prior

    @property
    def method(self) -> Method:
        """The inference rule."""
        return self.declared.method

    @property
    def evaluation(self) -> Evaluation:
        """How a posterior is tested."""
        return self.declared.evaluation

    @property
    def choices(self) -> dict[str, Any]:
        """The option that was chosen of every group."""
        return self.declared.choices

    @property
    def constants(self) -> dict[str, Any]:
        """Columns of the metric table that are the same in every row."""
        return {
            "experiment": self.settings.name,
            "method": self.choices.get("method", ""),
            "sim": self.system.source.name,
            "data": self.choices.get("data", ""),
            "output": "",
            "unit": "",
        }


def open_study(
    declared: Declared, data_folder: Path, *, whole: bool = True, groups: dict[str, tuple[str, ...]] | None = None
) -> Study:
    """Read the measurements of a configuration and bind its simulator to them.

    Args:
        declared: the configuration.
        data_folder: of the data YAML.
        whole: whether every state is needed in every row (see `data.reader.read`).
        groups: column -> names of the groups that a fit knows; None: those of the training rows.

    Raises:
        ConfigError: a key that does not fit the simulator.
        DataError: the measurements.
    """
    device = configure(declared.settings)
    measurements, source = declared.measurements, declared.source
    if groups and isinstance(source, Model):
        source = _grouped(source, groups)
    # the split does not depend on run.seed: every seed of a sweep is tested on the same episodes
    recording = _read(measurements, source, data_folder, whole=whole)
    if isinstance(source, Model) and recording.groups:
        source = _grouped(source.base or source, recording.groups)
    return Study(declared, device, system_of(source, recording.outputs, measurements.stack_actions), recording)


def _read(measurements: Measurements, source: Source, data_folder: Path, *, whole: bool) -> Recording:
    """Read measurements; where rows are needed whole and even and are not, the simulator's filter makes them so."""
    fills = whole and isinstance(source, Model)
    if not fills:
        return read(measurements, source, data_folder, 0, whole=whole)
    # a few rows calibrate no filter: those that are whole count
    recording = read(measurements, source, data_folder, 0, partial=True, too_few=estimated_rows.too_few)
    assert isinstance(source, Model)
    if not estimated_rows.needed(recording, source):
        return recording
    if recording.groups:
        source = _grouped(source.base or source, recording.groups)
    try:
        return estimated_rows.with_estimates(recording, source, tuple(measurements.noise_std))
    except DataError:
        if estimated_rows.whole(recording):  # with rows that stray a fit is worse, but it is one; the check says so
            return recording
        raise


def _grouped(source: Model, groups: dict[str, tuple[str, ...]]) -> Model:
    """Return the simulator whose parameters differ between the groups of the measurements.

    Raises:
        ConfigError: a parameter that cannot, or a name that is taken.
    """
    try:
        return grouped(source, groups)
    except ModelError as error:
        raise ConfigError(str(error)) from error


def refuse_untested(recording: Recording) -> None:
    """Refuse measurements of which nothing is kept to test on.

    Raises:
        DataError: with the cure.
    """
    if not recording.test:
        raise DataError(
            "there are no test data (data.split.test_fraction is 0, or there are no measurements). Keep some, or name "
            "others: simpel evaluate RUN_DIR data=NAME."
        )
