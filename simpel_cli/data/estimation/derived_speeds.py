"""Whether a measured velocity was computed from the measured position, and is no measurement of its own.

A difference quotient is found by itself. Whatever else makes a velocity of the position is a rational filter of it,

    v[k] = sum_i a[i] v[k + i] + sum_j c[j] p[k + j],

a weighted difference (no a), a digital filter behind a difference (a at rows before), or one that was run forwards and
backwards (a on both sides). Any smooth motion without noise fulfils such an equation. So the position must carry noise: its
high differences must be those of a white signal. That noise cannot be in a velocity of another sensor, and reading it through
c shows what an independent velocity would miss the equation by at least. Where numbers were rounded, `rounded_speeds` asks.

Reference: Savitzky and Golay (1964), Smoothing and differentiation of data by simplified least squares procedures; Oppenheim
and Schafer (2010), Discrete-time signal processing, 6.3 (rational filters).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.data.estimation.kinematics import Motion
from simpel_cli.data.estimation.position_noise import NORMAL, WHITE, on_grid, white_level
from simpel_cli.data.estimation.rounded_speeds import rounded_kind
from simpel_cli.data.recording import Check

DERIVED = 0.25  # of the velocity's noise; an independent sensor differs from a difference by at least all of it
ROWS_PER_WEIGHT = 5  # fewer, and least squares explain anything
FILTERED = 0.1  # of the position's noise in the velocity; one of its own sensor differs by all of it
NOISE_FREE = 1e-6  # of the velocity: less noise is rounding, and tells nothing of where the numbers came from
SMOOTHED = "smoothed"


class Filter(NamedTuple):
    """A form of filter that a velocity may come from.

    Args:
        reach: rows of the position to either side.
        before, after: rows of the velocity itself.
    """

    reach: int
    before: int = 0
    after: int = 0


FILTERS = (
    Filter(reach=5),  # Savitzky and Golay's, moving averages
    Filter(reach=3, before=2),  # up to second order, as a motor controller's or an encoder's driver
    Filter(reach=3, before=2, after=2),
)


def differences(motions: Sequence[Motion]) -> dict[str, str]:
    """Find velocities that were computed from the position, and so are no measurement of their own.

    Args:
        motions: pairs (position, velocity) with d(position)/dt = velocity in the simulator.

    Returns:
        Name of the velocity -> which difference of which position it is.
    """
    found = {}
    for motion in motions:
        kind = difference_kind(motion) or filter_kind(motion) or rounded_kind(motion)
        if kind:
            found[motion.velocity] = f"the {kind} difference of {motion.position}"
    return found


def derived(motions: Sequence[Motion], declared: Sequence[str] = ()) -> Check:
    """Report velocities that were computed from the position; those that were declared are no news."""
    found = {name: kind for name, kind in differences(motions).items() if name not in declared}
    note = f"{', '.join(declared)}: declared as computed from other columns" if declared else ""
    if not found:
        return Check("derived", True, note or "no velocity is a difference of its position")
    equal = "; ".join(f"{name} is {kind}" for name, kind in found.items())
    nulls = ", ".join(f"{name}: null" for name in found)
    also = f"; {note}" if note else ""
    return Check("derived", False, f"{equal}, not a measurement of its own: set data.columns {{{nulls}}}{also}")


def difference_kind(motion: Motion) -> str | None:
    """Say of which difference quotient of the position the velocity consists: central, forward or backward, or None."""
    columns: dict[str, list[np.ndarray]] = {"central": [], "forward": [], "backward": []}
    thirds, speeds = [], []
    for t, p, v in motion.pieces:
        if len(t) < 5:
            continue
        inner = v[1:-1]
        columns["central"].append((p[2:] - p[:-2]) / (t[2:] - t[:-2]) - inner)
        columns["forward"].append((p[2:] - p[1:-1]) / (t[2:] - t[1:-1]) - inner)
        columns["backward"].append((p[1:-1] - p[:-2]) / (t[1:-1] - t[:-2]) - inner)
        thirds.append(np.abs(np.diff(v, 3)) / np.sqrt(20))
        speeds.append(inner)
    if not speeds:
        return None
    typical = float(np.sqrt(np.median(np.concatenate(speeds) ** 2)))
    noise = float(np.median(np.concatenate(thirds)))
    if noise <= NOISE_FREE * typical or noise == 0:
        return None
    residuals = {kind: float(np.median(np.abs(np.concatenate(r)))) for kind, r in columns.items()}
    kind = min(residuals, key=lambda name: residuals[name])
    return kind if residuals[kind] < DERIVED * noise else None


def filter_kind(motion: Motion) -> str | None:
    """Say whether the velocity is a filtered difference of the position: `SMOOTHED`, or None. Rows may be missing."""
    pieces = [on_grid(*piece) for piece in motion.pieces if len(piece[0]) > 1]
    if not pieces:
        return None
    centre = np.nanmean(np.concatenate([p for p, _ in pieces]))
    pieces = [(p - centre, v) for p, v in pieces]
    levels = [white_level([p for p, _ in pieces], order) for order in (4, 8)]
    if not WHITE * levels[0] < levels[1] < levels[0] / WHITE:
        return None
    return SMOOTHED if any(_comes_from(form, pieces, levels[0]) for form in FILTERS) else None


def _comes_from(form: Filter, pieces: Sequence[tuple[np.ndarray, np.ndarray]], level: float) -> bool:
    """Whether such a filter makes the velocity of the position, whose noise has a level."""
    columns, targets = zip(*(_rows(form, p, v) for p, v in pieces), strict=True)
    design, target = np.concatenate(columns), np.concatenate(targets)
    there = np.isfinite(design).all(axis=1) & np.isfinite(target)
    design, target = design[there], target[there]
    if len(design) < ROWS_PER_WEIGHT * design.shape[1]:
        return False
    read = 2 * form.reach + 1
    position = design[:, :read]
    beside, centre = np.delete(position, form.reach, axis=1), position[:, form.reach]
    foreseen = beside @ np.linalg.lstsq(beside, centre, rcond=None)[0]
    if np.median(np.abs(centre - foreseen)) < WHITE * NORMAL * level:  # a swing, however coarsely it is sampled
        return False
    weights = np.linalg.lstsq(design, target, rcond=None)[0]
    passed = level * float(np.linalg.norm(weights[:read]))  # noise of the position that such a velocity has in it
    return bool(np.median(np.abs(target - design @ weights)) < FILTERED * passed)


def _rows(form: Filter, p: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a filter reads, (rows, weights), and the velocity that it makes of it, (rows,)."""
    begin, end = max(form.reach, form.before), len(p) - max(form.reach, form.after)
    k = np.arange(begin, max(begin, end))
    reads = [p[k + j] for j in range(-form.reach, form.reach + 1)]
    reads += [v[k + i] for i in range(-form.before, form.after + 1) if i]
    return np.stack(reads, axis=1), v[k]
