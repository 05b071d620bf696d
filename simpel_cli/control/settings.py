"""The `control:` group: how a policy meets the model, and how it is judged."""

from dataclasses import dataclass

from simpel_cli.control.world import SAMPLING
from simpel_cli.errors import ConfigError, check_at_least_one, did_you_mean

# groups and keys of a configuration that a fit does not have
CONTROL_GROUPS = ("policy", "planner", "reward", "truth", "mujoco", "control", "online", "world")


@dataclass(frozen=True)
class Control:
    """How a policy is trained in a posterior, and judged.

    Args:
        sampling: of the posterior: `tsinf` one particle for a whole roll-out, so that the return is that of a system that
            may be the true one; `ts1` a particle drawn anew at every step; `mean` the mean of all particles.
        aleatoric: whether roll-outs have the learned noise, too.
        data_share: share of the roll-outs that begin at a measured state; the others begin as the task does.
        episodes: that a policy is judged on, in the model and in the truth.
        fine_tune: steps of gradient ascent on the return in the model, from the best look on; it climbs the model's errors,
            too. What does not earn more in the model is not kept.
        fine_tune_rate: of Adam at the start, along a cosine.
        fine_tune_reach: steps within which what an action leads to fades from the gradient, by a factor of e.
        precondition: what `method.precondition` is where it is not set. Networks that follow the gradient have after 5000
            steps left out what the simulator says in few directions of many inputs, such as that steering turns the car:
            good enough for one step ahead, and nothing to drive by.
    """

    sampling: str = "tsinf"
    aleatoric: bool = True
    data_share: float = 0.5
    episodes: int = 100
    fine_tune: int = 100
    fine_tune_rate: float = 3e-3
    fine_tune_reach: float = 20.0
    precondition: bool = True

    def __post_init__(self) -> None:
        if self.sampling not in SAMPLING:
            hint = did_you_mean(self.sampling, list(SAMPLING))
            raise ConfigError(f"control.sampling: got {self.sampling!r}; allowed are {', '.join(SAMPLING)}.{hint}")
        if not 0 <= self.data_share <= 1:
            raise ConfigError(f"control.data_share: got {self.data_share}; allowed is 0 to 1.")
        check_at_least_one("control", self, ("episodes",))
        if self.fine_tune < 0:
            raise ConfigError(f"control.fine_tune: got {self.fine_tune}; it must be 0 (off) or more.")
        for name in ("fine_tune_rate", "fine_tune_reach"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"control.{name}: got {getattr(self, name)}; it must be positive.")
