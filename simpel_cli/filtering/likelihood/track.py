"""What a filter takes and leaves behind: noise, its track through a window, its functions."""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Float


class Noise(NamedTuple):
    """Standard deviations of the measurements (ny, ...) and of the process, per square root of a second (nx, ...)."""

    r: Float[Array, "ny ..."]
    q: Float[Array, "nx ..."]


class Track(NamedTuple):
    """What the filter leaves behind, one row per measured row."""

    innovation: Float[Array, "T ny ..."]
    variance: Float[Array, "T ny ..."]
    predicted: Float[Array, "T nx ..."]
    predicted_cov: Float[Array, "T nx nx ..."]
    mean: Float[Array, "T nx ..."]
    cov: Float[Array, "T nx nx ..."]
    jacobian: Float[Array, "T nx nx ..."]  # of the transition to the next row
    slope: Float[Array, "T ny nx ..."]  # of what the sensors read, in the predicted state


class Held(NamedTuple):
    """What stays as it is where a parameter moves, one row per measured row."""

    gain: Float[Array, "T ny nx ..."]  # 0 where a measurement does not count
    prompt: Float[Array, "T ny nx ..."]  # slope of what the sensors would read, were none late
    rate_x: Float[Array, "T nx nx ..."]  # slope of the rates in the state, at the end of the row before
    pace: Float[Array, "T ..."] | None  # step to the next row, in dt; None: all are dt


class Filter(NamedTuple):
    """The filter of one augmented model; every array may have further axes behind those named here.

    Args:
        track: (p, noise, y, ok, u, start, spread) -> Track, for one window (see `Windows`), and Held.
        moved: (moving, noise, track, held, y, ok, u, start, spread) -> innovations and variances: to be differentiated in
            what moves.
        louder: (noise, track, held, ok, spread) -> innovations and variances: to be differentiated in the noise.
        flow: (p, x, u of the substeps, (substeps, K, nu)) -> x one row later.
        measure: (p, x, u) -> what the sensors read.
        read: (p, x of the row before, its u of the substeps, x, u of the substeps) -> what is read in a row, of which each
            value may have been measured before it.
        delayed_inputs: (p, u) -> inputs as they arrive, (T, substeps, K, nu): held over a substep, or at its beginning, middle
            and end; what stands behind the inputs, behind them.
    """

    track: Callable[..., tuple[Track, Held]]
    moved: Callable[..., tuple[Float[Array, "T ny"], Float[Array, "T ny"]]]
    louder: Callable[..., tuple[Float[Array, "T ny"], Float[Array, "T ny"]]]
    flow: Callable[..., Float[Array, " nx"]]
    measure: Callable[..., Float[Array, " ny"]]
    read: Callable[..., Float[Array, " ny"]]
    delayed_inputs: Callable[..., Float[Array, "T substeps K nu"]]
