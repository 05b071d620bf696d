"""simpel: simulation priors for data-efficient learning."""

import os
from importlib.metadata import PackageNotFoundError, version

NO_YNN = "--xla_cpu_experimental_ynn_fusion_type="
# Loops whose steps read less than 1 MB are one kernel each. Else every step calls dozens of them, each with few numbers to work
# out, and the calls are half of the time of a filter (seen with 0.10.2; a version that does not know the key ignores it).
SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000"


def _with_switches() -> None:
    """Set the switches of XLA that simpel needs; must run before JAX opens its backend.

    With `NO_YNN` go the fusions with which jaxlib 0.10.2 to 0.12 silently computes wrong results on CPU (see jax-ml/jax#39103):
    conjugate gradients with a matrix-valued operator came out wrong in 18 of 40 compilations, NaN or off by 1e100
    (`tests/dynamics/test_jax.py`, seen with 0.10.2 and 0.12.0.1). Later versions may not know a flag, and would not start
    with it. Flags of the user's that name the same switch, or a file, are left alone.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if flags and not flags.startswith("-"):  # it names a file of flags
        return
    try:
        found = tuple(int(part) for part in version("jaxlib").split(".")[:2])
    except (PackageNotFoundError, ValueError):
        return
    wanted = (SMALL_LOOPS, NO_YNN) if (0, 10) <= found <= (0, 12) else ()
    new = [one for one in wanted if one.split("=")[0] not in flags]
    os.environ["XLA_FLAGS"] = " ".join([*new, flags]).strip()


_with_switches()
