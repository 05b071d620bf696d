"""The `evaluation:` group."""

from dataclasses import dataclass

from simpel_cli.errors import ConfigError


@dataclass(frozen=True)
class Evaluation:
    """How a posterior is judged.

    Args:
        horizon: length of the free runs, s; null = 20 transitions.
    """

    horizon: float | None = None

    def __post_init__(self) -> None:
        if self.horizon is not None and not self.horizon > 0:
            raise ConfigError(f"evaluation.horizon: got {self.horizon}; it must be positive (s).")

    def steps(self, dt: float) -> int:
        """Number of transitions in the horizon, at least 1."""
        return 20 if self.horizon is None else max(1, round(self.horizon / dt))
