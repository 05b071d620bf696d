"""Gaps in the time stamps of a recording: an episode is cut there."""

import math

import numpy as np

from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Check
from simpel_cli.data.rows import Rows, follows

MANY_GAPS = 0.01  # of the steps; more are a clock that is irregular


def cut_at_gaps(rows: Rows, dt: float, config: Measurements) -> tuple[Check, np.ndarray]:
    """Cut episodes where time is missing: find where a segment of contiguous rows starts.

    Args:
        rows: checked for NaN.
        dt: of the data, s; of irregular rows the longest usual step.
        config: `max_gap`, s; null = 1.5 steps, of the data or of what they are resampled to.

    Returns:
        The check, and a mask (n,): True at the first row of every segment (new episode, new split, dropped row, gap).
    """
    limit = 1.5 * max(dt, config.resample or 0.0) if config.max_gap is None else config.max_gap
    steps = np.diff(rows.time)
    gap = follows(rows) & (steps > limit)
    starts = np.concatenate([[True], ~follows(rows) | gap | (rows.split[1:] != rows.split[:-1])])
    if not gap.any():
        return Check("gaps", True, f"no step longer than {limit:.3g} s"), starts
    shown = [f"episode {rows.episode[i]} at {rows.time[i]:.4g} s ({steps[i]:.3g} s)" for i in np.flatnonzero(gap)[:3]]
    more = ", ..." if gap.sum() > len(shown) else ""
    detail = f"{int(gap.sum())} gaps longer than {limit:.3g} s, cut there: {', '.join(shown)}{more}"
    if config.resample is not None and gap.sum() > MANY_GAPS * np.sum(follows(rows)):
        detail += f". Wider ones are bridged with {_bridge(steps[follows(rows)], limit, '')}"
    return Check("gaps", False, detail), starts


def _bridge(steps: np.ndarray, limit: float, before: str) -> str:
    """Say which data.max_gap passes over 99 % of the steps; nothing if they are no longer than the limit anyway."""
    longest = float(np.percentile(steps, 99))
    if longest <= limit:
        return ""
    digit = 10.0 ** (math.floor(math.log10(longest)) - 1)
    return f"{before}data.max_gap: {math.ceil(longest / digit) * digit:.4g}"
