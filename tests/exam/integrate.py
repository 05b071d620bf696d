"""The exam's integrator: classical Runge-Kutta, eight steps per row.

A step ends wherever a late command arrives, and more of them while a fast lag follows it.
Commands are held from row to row, arrive `delay` later, pass a first-order `lag`, then act. Before the record the first
command is assumed. Process noise is added after every step (Euler and Maruyama), which is exact where it enters linearly.

Reference: Kutta (1901); Kloeden and Platen (1992), chapter 9.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

FINE = 8  # steps per row
SETTLING = (0.25, 0.5, 0.75, 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 14, 20)  # lags after an arrival, where a step ends
LEAST_LAG = 1e-6  # of a row: below, an actuator follows at once
NEAR = 1e-9  # s, relative to a row: instants this close are one

Rate = Callable[[np.ndarray, np.ndarray, float], np.ndarray]  # (x (B, nx), u (B, nu), t) -> (B, nx)
Controller = Callable[[np.ndarray, int], np.ndarray]  # (x (B, nx), row) -> u (B, nu)


def simulate(
    rate: Rate,
    start: np.ndarray,
    commands: np.ndarray,
    dt: float,
    *,
    controller: Controller | None = None,
    delay: Sequence[float] = (),
    lag: Sequence[float] = (),
    diffusion: np.ndarray | None = None,
    random: np.random.Generator | None = None,
    fine: int = FINE,
    tap: float = 0.0,
    play: Sequence[float] = (),
    sensor_lag: np.ndarray | None = None,
    linear: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate a batch of episodes.

    Args:
        rate: time derivative of the state.
        start: (B, nx) first states.
        commands: (B, rows, nu); overwritten row by row where there is a controller.
        dt: s, distance of the rows.
        controller: feedback from the true state at a row.
        delay: s per input; none = 0.
        lag: s per input; 0 = none.
        diffusion: (nx,) of the process noise, per square root of a second.
        random: for the process noise.
        fine: steps per row.
        tap: s after each row, less than dt: where the states are recorded a second time, for late sensors.
        play: half width of the play in front of each input; none = 0.
        linear: commands go straight from a row to the next.
        sensor_lag: (nx,) time constants of sensors with a first-order lag, s; 0 = none. They begin at the first states.

    Returns:
        states (B, rows, nx) at the rows, states `tap` later (what lagging sensors read there, where there are any), and
        the commands as they were given (B, rows, nu).
    """
    commands = np.array(commands, float)
    count, rows, inputs = commands.shape
    late = np.zeros(inputs) if len(delay) == 0 else np.asarray(delay, float)
    slow = np.zeros(inputs) if len(lag) == 0 else np.where(np.asarray(lag) > LEAST_LAG * dt, lag, 0.0)
    settling = [d + c * tau for d, tau in zip(late, slow, strict=True) for c in SETTLING if 0 < c * tau < dt]
    offsets = _offsets(dt, fine, [*np.mod([*late, *settling], dt), tap])
    x = np.array(start, float)
    if controller is not None:
        commands[:, 0] = controller(x, 0)
    z = commands[:, 0].copy()  # what the actuators deliver
    passed, half = commands.copy(), np.zeros(inputs) if len(play) == 0 else np.asarray(play, float)
    read, slowly = x.copy(), sensor_lag is not None and bool(np.any(sensor_lag))
    states, tapped = np.empty((count, rows, x.shape[1])), np.empty((count, rows, x.shape[1]))
    for row in range(rows):
        if controller is not None:
            commands[:, row] = controller(x, row)
        passed[:, row] = np.clip(passed[:, max(row - 1, 0)], commands[:, row] - half, commands[:, row] + half)
        states[:, row] = x
        for a, b in itertools.pairwise(offsets):
            if abs(a - tap) <= NEAR * dt:
                tapped[:, row] = read if slowly else x
            middle = row + ((a + b) / 2 - late) / dt
            given = np.clip(np.floor(middle).astype(int), 0, rows - 1)
            held = np.stack([passed[:, k, j] for j, k in enumerate(given)], -1)
            rise = np.zeros_like(held)
            if linear:  # commands at the beginning of the step, and how they rise along it
                way = np.clip(row + (a - late) / dt - given, 0.0, 1.0)
                following = np.stack([passed[:, min(k + 1, rows - 1), j] for j, k in enumerate(given)], -1)
                rise = (following - held) * (b - a) / dt
                held = held + (following - held) * way
            before = x
            x, z = _step(rate, x, z, held, slow, row * dt + a, b - a, rise)
            if slowly:
                read = _followed(read, before, x, sensor_lag, b - a)
            if diffusion is not None and random is not None:
                x = x + diffusion * np.sqrt(b - a) * random.standard_normal(x.shape)
    return states, tapped, commands


def _offsets(dt: float, fine: int, instants: Sequence[float]) -> list[float]:
    """Ends of the steps within a row."""
    found: list[float] = []
    for t in sorted([*(dt * np.arange(fine + 1) / fine), *instants]):
        if not found or t - found[-1] > NEAR * dt:
            found.append(float(t))
    found[-1] = dt
    return found


def _followed(read: np.ndarray, before: np.ndarray, after: np.ndarray, lag: np.ndarray, h: float) -> np.ndarray:
    """What first-order lags read after a step in which the states moved along a line: the exact answer to a ramp."""
    tau = np.where(lag > 0, lag, 1.0)
    slope = (after - before) / h
    own = after - tau * slope + (read - before + tau * slope) * np.exp(-h / tau)
    return np.where(lag > 0, own, after)


def _step(
    rate: Rate, x: np.ndarray, z: np.ndarray, held: np.ndarray, slow: np.ndarray, t: float, h: float, rise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One step of classical Runge-Kutta of the states; lags are solved exactly, for commands that are held or rise."""
    at = []
    for share in (0.0, 0.5, 1.0):
        tau = np.where(slow > 0, slow, 1.0)
        decay = np.where(slow > 0, np.exp(-share * h / tau), 0.0)
        behind = np.where(slow > 0, tau / h, 0.0) * rise  # a lag follows a ramp at this distance
        at.append(held + share * rise - behind + (z - held + behind) * decay)
    k1 = rate(x, at[0], t)
    k2 = rate(x + h / 2 * k1, at[1], t + h / 2)
    k3 = rate(x + h / 2 * k2, at[1], t + h / 2)
    k4 = rate(x + h * k3, at[2], t + h)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), at[2]
