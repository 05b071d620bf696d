"""Whether a measured velocity is the rate of the measured position: scale, sign, offset.

    p(t_k+w) - p(t_k) = s * integral_t_k^t_k+w v dt + o * (t_k+w - t_k) + noise,      s = 1, o = 0

The integral is compared, not the derivative, which would drown in the position's noise; w is the window in which
least squares find s best. The velocity's own noise biases s by less than its share of the variance in a window.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.checks.noise import third_difference_std
from simpel_cli.data.recording import Check

TOLERANCE = 0.05  # of the scale, and of the velocity's standard deviation for an offset
SIGNIFICANCE = 5.0  # standard errors
UNRELATED = 0.5  # of the variance of the position's changes; more left unexplained is not this position's rate
NOISE_SHARE = 4.0  # times the variance of the noise, which is an estimate, may stay unexplained
FEW_WINDOWS = 12
RESTING = 4.0  # times the variance that its noise alone gives the integrated velocity; below, it tells nothing
FACTORS = {  # velocity column / rate of the position
    180 / np.pi: "the velocity looks like degrees per s where the position is in rad",
    np.pi / 180: "the position looks like degrees where the velocity is in rad per s",
    1000.0: "the velocity looks like mm/s where the position is in m, or the time like ms",
    0.001: "the position looks like mm where the velocity is in m/s",
    100.0: "the velocity looks like cm/s where the position is in m",
    0.01: "the position looks like cm where the velocity is in m/s",
    2 * np.pi: "the velocity looks like rad per s where the position is in turns",
    1 / (2 * np.pi): "the velocity looks like turns per s where the position is in rad",
    60.0: "the velocity looks like one per minute, not per s",
    30 / np.pi: "the velocity looks like turns per minute where the position is in rad",
    3.6: "the velocity looks like km/h where the position is in m",
}


class Motion(NamedTuple):
    """A measured position and the measured velocity that the simulator calls its rate.

    Args:
        position: name.
        velocity: name.
        unit: of the velocity.
        pieces: contiguous rows (time s, position, velocity), each (T,), angles unwrapped.
    """

    position: str
    velocity: str
    unit: str
    pieces: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]


class Agreement(NamedTuple):
    """Least squares of the position's changes on the integrated velocity."""

    ratio: float  # velocity column / rate of the position, 1/s
    ratio_error: float  # standard error, relative
    offset: float  # what the velocity reads at rest, in its unit
    offset_error: float
    unexplained: float  # share of the variance of the position's changes that neither explains, nor noise


def kinematics(motions: Sequence[Motion]) -> Check:
    """Compare every measured velocity with the rate of its position: scale, sign, offset.

    Args:
        motions: pairs (position, velocity) with d(position)/dt = velocity in the simulator.
    """
    if not motions:
        return Check("kinematics", True, "no position is measured along with its velocity")
    faults = [fault for motion in motions if (fault := _fault(motion))]
    names = ", ".join(f"{m.velocity} = d({m.position})/dt" for m in motions)
    return Check("kinematics", not faults, "; ".join(faults) if faults else names)


def agreement(motion: Motion) -> Agreement | None:
    """Fit scale and offset between a velocity and the rate of its position; None where rows are too few, or rest."""
    from scipy.interpolate import CubicSpline  # here, since its import takes long

    pieces = [piece for piece in motion.pieces if len(piece[0]) >= 4]
    walked = [(t, p, CubicSpline(t, v).antiderivative()(t)) for t, p, v in pieces]
    noise = [_noise([piece[i] for piece in pieces]) for i in (1, 2)]
    best: tuple[float, float, np.ndarray] | None = None
    length = max((len(t) for t, _, _ in walked), default=0)
    for power in range(length.bit_length()):
        width = 1 << power
        rows = [np.stack([t, p, s])[:, : (len(t) - 1) // width * width + 1 : width] for t, p, s in walked]
        windows = np.concatenate([np.diff(columns, axis=1) for columns in rows], axis=1)
        if windows.shape[1] < FEW_WINDOWS:
            continue
        signal = float(np.sum(windows[2] ** 2))
        dt = float(np.mean(windows[0])) / width
        of_velocity = width * (dt * noise[1]) ** 2
        if signal <= RESTING * windows.shape[1] * of_velocity:
            continue
        variance = 2 * noise[0] ** 2 + of_velocity
        if best is None or variance / signal < best[0]:
            best = variance / signal, variance, windows
    if best is None:
        return None
    time, change, integral = best[2]
    return _fit(time, change, integral, best[1]) if np.any(change) else None


def _fit(time: np.ndarray, change: np.ndarray, integral: np.ndarray, variance: float) -> Agreement:
    """Least squares over windows: change = s integral + o time; then v = change/time / s - o/s."""
    design = np.stack([integral, time], axis=1)
    size = np.sqrt((design**2).sum(axis=0))
    gram = (design / size).T @ (design / size)
    if np.linalg.eigvalsh(gram)[0] < 1e-3:  # a constant speed: what is offset and what is scale cannot be known
        design, size, gram = design[:, :1], size[:1], np.ones((1, 1))
    coefficients = np.linalg.solve(gram, (design / size).T @ change)
    residual = change - (design / size) @ coefficients
    freedom = max(len(change) - len(coefficients), 1)
    error = np.sqrt(np.diag(np.linalg.inv(gram)) * (residual @ residual) / freedom)
    (scale, scale_error), *rest = zip(coefficients / size, error / size, strict=True)
    drift, drift_error = rest[0] if rest else (0.0, 0.0)
    scale = scale if abs(scale) > 1e-12 else 1e-12
    unexplained = float(max(residual @ residual - NOISE_SHARE * len(change) * variance, 0.0) / (change @ change))
    return Agreement(
        1 / scale, abs(scale_error / scale), -drift / scale, max(abs(drift_error / scale), 1e-300), unexplained
    )


def _fault(motion: Motion) -> str | None:
    """What is wrong with a velocity, in words; None if nothing is."""
    found = agreement(motion)
    if found is None:
        return None
    pair = f"{motion.velocity} and d({motion.position})/dt"
    scale, error = 1 / found.ratio, found.ratio_error / abs(found.ratio)
    wrong = abs(found.ratio - 1) > TOLERANCE and abs(scale - 1) > SIGNIFICANCE * error
    if found.unexplained > UNRELATED or (wrong and abs(scale) < SIGNIFICANCE * error):
        return (
            f"{pair} do not go together: {found.unexplained:.0%} of the position's changes are not in the velocity. "
            "Wrong column, other units, a delay between the two, or an angle that turns more than half a turn per row"
        )
    if wrong:
        return f"{motion.velocity} is {found.ratio:.4g} times d({motion.position})/dt{_hint(found.ratio, motion)}"
    spread = float(np.std(np.concatenate([v for _, _, v in motion.pieces])))
    if abs(found.offset) > max(TOLERANCE * spread, SIGNIFICANCE * found.offset_error):
        return (
            f"{motion.velocity} reads {found.offset:.3g} {motion.unit}".rstrip()
            + f" where {motion.position} stands still: an offset of the sensor"
        )
    return None


def _hint(ratio: float, motion: Motion) -> str:
    sign = ": the sign is flipped" if ratio < 0 else ""
    size = abs(ratio)
    if abs(size - 1) <= TOLERANCE:
        return sign
    rows = float(np.median(np.concatenate([np.diff(t) for t, _, _ in motion.pieces])))
    known = FACTORS | {rows: "the velocity looks like a change per row, not per s"}
    nearest = min(known, key=lambda factor: abs(np.log(size / factor)))
    if abs(size / nearest - 1) > TOLERANCE:
        return sign or ": compare their units"
    return f"{sign}, and {known[nearest]}" if sign else f": {known[nearest]}"


def _noise(pieces: Sequence[np.ndarray]) -> float:
    sigma = third_difference_std(pieces)
    return sigma if np.isfinite(sigma) else 0.0
