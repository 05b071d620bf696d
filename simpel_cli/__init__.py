"""simpel: simulation priors for data-efficient learning."""

import os
from importlib.metadata import PackageNotFoundError, version

NO_YNN = "--xla_cpu_experimental_ynn_fusion_type="


def _without_wrong_fusions() -> None:
    """Switch off the fusions with which jaxlib 0.10.2 to 0.12 silently computes wrong results on CPU (see jax-ml/jax#39103).

    Conjugate gradients with a matrix-valued operator came out wrong in 18 of 40 compilations, NaN or off by 1e100
    (`tests/dynamics/test_jax.py`, seen with 0.10.2 and 0.12.0.1). Must run before JAX opens its backend; flags of the user's
    that name the same switch, or a file, are left alone. Later versions may not know the switch, and would not start with it.
    """
    try:
        found = tuple(int(part) for part in version("jaxlib").split(".")[:2])
    except (PackageNotFoundError, ValueError):
        return
    flags = os.environ.get("XLA_FLAGS", "")
    plain = not flags or flags.startswith("-")  # else it names a file of flags
    if (0, 10) <= found <= (0, 12) and plain and "ynn_fusion" not in flags:
        os.environ["XLA_FLAGS"] = f"{NO_YNN} {flags}".strip()


_without_wrong_fusions()
