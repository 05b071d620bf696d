"""The `online:` group: how episodes in the plant follow each other."""

from dataclasses import dataclass

from simpel_cli.errors import ConfigError, check_at_least_one

MEASURED = (
    "noise_std",
    "noise",
    "stack_actions",
    "max_gap",
    "derived",
)  # keys of the data YAML that hold for a plant's episodes


@dataclass(frozen=True)
class Online:
    """Learning from episodes of the policy's own.

    Args:
        episodes: in the plant.
        warm_start: a policy is trained from where the one of the episode before ended; else from nothing.
        keep_better: the policy of the episode before goes on where it earns more in the new model than the new one does: a
            training that ended in a local optimum costs no episode.
        wait: s, for an episode of a rig behind a folder.
    """

    episodes: int = 10
    warm_start: bool = False
    keep_better: bool = True
    wait: float = 3600.0

    def __post_init__(self) -> None:
        check_at_least_one("online", self, ("episodes",))
        if not self.wait > 0:
            raise ConfigError(f"online.wait: got {self.wait}; it must be positive (s).")
