"""Scalars for TensorBoard beside the metrics, where `run.tensorboard=true` asks for them (extra `simpel[tensorboard]`)."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from simpel_cli.errors import ConfigError


class Scalars:
    """Event file of a run.

    Args:
        directory: of the run; the file lies in `tensorboard/` below.
        resume_at: step from which a resumed run writes anew; what lies behind it is purged.

    Raises:
        ConfigError: tensorboardX is not installed.
    """

    def __init__(self, directory: Path, resume_at: int | None = None) -> None:
        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise ConfigError(
                "run.tensorboard: tensorboardX is not installed: pip install 'simpel[tensorboard]'."
            ) from error
        self._writer = SummaryWriter(str(directory / "tensorboard"), purge_step=resume_at)

    def add(self, rows: Iterable[dict[str, Any]]) -> None:
        """Write metric rows; a tag is `split/metric/output`, with the seed where it is not 0."""
        for row in rows:
            parts = [row["split"], row["metric"], row.get("output") or ""]
            tag = "/".join(filter(None, [*parts, f"seed {row['seed']}" if row.get("seed") else ""]))
            self._writer.add_scalar(tag, row["value"], int(row["step"]))

    def close(self) -> None:
        """Write what is held back."""
        self._writer.close()
