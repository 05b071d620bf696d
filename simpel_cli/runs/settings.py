"""The `run:` group, and what it sets up: device, precision, compilation cache, named random streams."""

import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simpel_cli.errors import ConfigError

if TYPE_CHECKING:
    import jax
    from jaxtyping import PRNGKeyArray


@dataclass(frozen=True)
class Settings:
    """The `run:` group of every verb.

    Args:
        name: name of the run in metrics and in the run directory's path.
        seed: random seed of the model; seeds of several runs in one program count up from it.
        seeds: number of seeds that are trained at once.
        precision: `float32` or `float64` for learning (priors' factorisations always run in float64).
        device: `auto`, `cpu` or `gpu`.
        cache: keep compiled programs in the user's cache directory.
        quiet: print errors only.
        figures: draw figures; without them the report has its tables, and a small job of a large sweep ends sooner.
        tensorboard: write scalars for TensorBoard into `tensorboard/` of the run, too.
        plugins: packages of the user's that `_target_` and callables may name.
    """

    name: str = "run"
    seed: int = 0
    seeds: int = 1
    precision: str = "float32"
    device: str = "auto"
    cache: bool = True
    quiet: bool = False
    figures: bool = True
    tensorboard: bool = False
    plugins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.precision not in ("float32", "float64"):
            raise ConfigError(f"run.precision: got {self.precision!r}; allowed are float32 and float64.")
        if self.device not in ("auto", "cpu", "gpu"):
            raise ConfigError(f"run.device: got {self.device!r}; allowed are auto, cpu and gpu.")
        if not 1 <= self.seeds <= 1000:
            raise ConfigError(f"run.seeds: got {self.seeds}; allowed are 1 to 1000.")
        if not 0 <= self.seed < 2**31:
            raise ConfigError(f"run.seed: got {self.seed}; allowed are 0 to 2147483647.")

    @property
    def all_seeds(self) -> list[int]:
        """The seeds of this run."""
        return list(range(self.seed, self.seed + self.seeds))


def configure(settings: Settings) -> "jax.Device":
    """Set up JAX for this process: float64 available, device, persistent compilation cache.

    Returns:
        The device that computations run on.

    Raises:
        ConfigError: `run.device=gpu` and JAX sees none.
    """
    import jax

    # float64 is enabled for factorisations and discovery; learning states its dtype and stays in run.precision
    jax.config.update("jax_enable_x64", True)
    # a GPU multiplies float32 in TF32 otherwise, with 10 bits of mantissa: scores came out wrong by 9 % (H200)
    jax.config.update("jax_default_matmul_precision", "highest")
    if settings.cache:
        jax.config.update("jax_compilation_cache_dir", str(cache_directory() / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if settings.device == "auto":
        return jax.devices()[0]
    try:
        device = jax.devices(settings.device)[0]
    except RuntimeError as error:
        raise ConfigError(
            f"run.device: got {settings.device}; JAX sees {jax.default_backend()} only. "
            "Use run.device=auto, or install jax[cuda13]."
        ) from error
    jax.config.update("jax_default_device", device)
    return device


def current_device() -> "jax.Device":
    """Where computations run: `run.device=cpu` on a machine with a GPU is the CPU."""
    import jax

    config: Any = jax.config
    device: Any = config.jax_default_device or jax.devices()[0]
    found: jax.Device = jax.devices(device)[0] if isinstance(device, str) else device
    return found


def cache_directory() -> Path:
    """Return the user's cache directory for simpel ($XDG_CACHE_HOME/simpel or ~/.cache/simpel)."""
    root = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(root) if root else Path.home() / ".cache") / "simpel"
    except RuntimeError as error:  # no home directory
        raise ConfigError(
            "no home directory: set XDG_CACHE_HOME, or switch the cache off with run.cache=false."
        ) from error


def stream(seed: int, name: str) -> "PRNGKeyArray":
    """Return the random stream `name` of an integer seed; streams of different names are independent."""
    import jax

    return jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode()))
