"""What a sensor read before its row: late transport, a clock of its own, or a rate of its own, all known.

Between two rows a state follows from both of them and their rates, to fourth order in the step (cubic Hermite):

    x(t - e) = x + (1 + 2 s)(1 - s)^2 (x_0 - x) + s (1 - s)^2 h f_0 + s^2 (s - 1) h f,    s = 1 - e/h

with the row before, (x_0, f_0), a step h away. In the state at the row its slope is 1 - e A + e^2/2 A^2, A: slope of the rates.
"""

from jaxtyping import Array, Float

from simpel_cli.filtering.likelihood.small_matrices import product


def way_back(
    early: Float[Array, "ny ..."],
    x: Float[Array, "nx ..."],
    rate: Float[Array, "nx ..."],
    row_before: tuple[Array, ...],
) -> Float[Array, "ny nx ..."]:
    """Return where the state was when each value was measured, less the state at the row.

    Args:
        early: how long before the row each value was measured, s; at most as long as the row before lies back.
        x: state at the row.
        rate: of it.
        row_before: state and rate at the row before, and the time since, s.
    """
    x_0, rate_0, step = row_before
    s = 1 - early / step[None]
    back, along, here = (1 + 2 * s) * (1 - s) ** 2, s * (1 - s) ** 2, s**2 * (s - 1)
    return (
        back[:, None] * (x_0 - x)[None]
        + along[:, None] * (step[None] * rate_0)[None]
        + here[:, None] * (step[None] * rate)[None]
    )


def slope_back(
    early: Float[Array, "ny ..."], slope: Float[Array, "ny nx ..."], rate_x: Float[Array, "nx nx ..."]
) -> Float[Array, "ny nx ..."]:
    """Return the slope of what was read in the state at the row; slope: as if it had been read there."""
    once = product(slope, rate_x)
    return slope - early[:, None] * once + early[:, None] ** 2 / 2 * product(once, rate_x)
