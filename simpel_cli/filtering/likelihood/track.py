"""What a filter takes and leaves behind: noise, its track through a window, its functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

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
    """What the derivatives along a track need of it, one row per measured row."""

    gain: Float[Array, "T ny nx ..."]  # 0 where a measurement does not count
    prompt: Float[Array, "T ny nx ..."]  # slope of what the sensors would read, were none late
    rate_x: Float[Array, "T nx nx ..."]  # slope of the rates in the state, at the end of the row before
    pace: Float[Array, "T ..."] | None  # step to the next row, in dt; None: all are dt
    u: Float[Array, "T substeps K nu ..."]  # as they arrive, and what stands behind the inputs
    stages: Float[Array, "T substeps 3 nx ..."]  # states at the beginning, in the middle and at the end of a substep
    stage_x: Float[Array, "T substeps 3 nx nx ..."]  # slope of the rates there
    motion: Any  # `Motion` at the end of the row before, (T, nx, ...) each; None: no sensor is late
    jumps: Float[Array, "T K orders ny ..."] | None  # of what the sensors read, before the row; None: no sensor is late


class Ways(NamedTuple):
    """How what moves at a row moves on: slopes in the state; None: not needed.

    Args:
        first: of the rates, at the filtered state and the row's first input.
        now: of the rates, at the predicted state and the row's first input.
        end: of the rates, at the end of the row.
        turn: of the rates' slopes, at the beginning and the end of the row.
    """

    first: Float[Array, "T nx nx ..."] | None
    now: Float[Array, "T nx nx ..."] | None
    end: Float[Array, "T nx nx ..."] | None
    turn: Float[Array, "T nx nx nx 2 ..."] | None


class Pushes(NamedTuple):
    """What one unit of a parameter adds along a track, where the state is the same; None: not needed.

    D directions at every row.

    Args:
        state: to the state at the end of the row.
        reading: to what the sensors read.
        first: to the rates, where `Ways.first` is their slope; `now` and `end` likewise.
        turn: to the slope of the rates in the state, mean of both ends of the row.
        bent: to that slope at the end of the row before, or where the window begins.
    """

    state: Float[Array, "T D nx ..."]
    reading: Float[Array, "T D ny ..."]
    first: Float[Array, "T D nx ..."] | None
    now: Float[Array, "T D nx ..."] | None
    end: Float[Array, "T D nx ..."] | None
    turn: Float[Array, "T D nx nx ..."] | None
    bent: Float[Array, "T D nx nx ..."] | None


class Filter(NamedTuple):
    """The filter of one augmented model; every array may have further axes behind those named here.

    Args:
        name: a digest of all that it is made of: filters of one name are the same.
        track: (p, noise, y, ok, u, start, spread) -> Track, for one window (see `Windows`), and Held.
        pushes: (p, rows, track, held, u) -> Ways, and Pushes: of one unit of p[row], for each of rows (D,), or (D, L) of which
            each is for one of L parts of the points' last axis, of one p; beyond the last row: nothing.
        slopes: (p, noise, louder, track, held, ok, ways, pushes) -> derivatives of innovations and variances, (D, T, ny, ...)
            each: first in the directions of the noise that `louder` holds, then along the pushes.
        flow: (p, x, u of the substeps, (substeps, K, nu)) -> x one row later.
        measure: (p, x, u) -> what the sensors read.
        read: (p, x of the row before, its u of the substeps, x, u of the substeps, jumps) -> what is read in a row, of which
            each value may have been measured before it, and the jumps of its motion before the next row, which
            late sensors still show: (jumps, ORDERS, ny), 0 before the first row.
        delayed_inputs: (p, u) -> inputs as they arrive, (T, substeps, K, nu): held over a substep, or at its beginning, middle
            and end (see `simpel_cli.dynamics.input_delay`); what stands behind the inputs, behind them.
        jumps: of the motion that late sensors may still show: of some rows, one for every step in which an input may arrive.
        remainders: rows of the state that are no part of a simulation (see `remainders.py`).
    """

    name: str
    track: Callable[..., tuple[Track, Held]]
    pushes: Callable[..., tuple[Ways, Pushes]]
    slopes: Callable[..., tuple[Float[Array, "D T ny"], Float[Array, "D T ny"]]]
    flow: Callable[..., Float[Array, " nx"]]
    measure: Callable[..., Float[Array, " ny"]]
    read: Callable[..., tuple[Float[Array, " ny"], Float[Array, "K orders ny"]]]
    delayed_inputs: Callable[..., Float[Array, "T substeps K nu"]]
    jumps: int = 0
    remainders: tuple[int, ...] = ()
