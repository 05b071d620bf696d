"""The rig of a set: its plant with everything planted, and what its sensors read without noise."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from tests.exam import nuisances
from tests.exam.draw import Set
from tests.exam.integrate import Rate, simulate
from tests.exam.planted import DELAY, INPUT, LAG, LATE_SENSOR, OWN_RATE, PLAY, RATE, SENSOR, SLOW_SENSOR, Effect
from tests.exam.plants import SYSTEMS, System

ROWS = 60
SETTLED = 8.0  # lags of a slow sensor after which its start is forgotten

Knobs = tuple[dict[str, float], ...]  # of every effect of a set


class Before(NamedTuple):
    """What lies before the first row, which late and slow sensors show.

    Args:
        commands: (B, lead + ROWS + rest, nu), the first one as long as nothing is recorded.
        lead: rows before the first one.
        behind: rows by which a late sensor is late, rounded up.
        share: of a row after which the states are recorded once more.
        channel: the late sensor's.
        settling: (nx,) time constants of slow sensors, s.
    """

    commands: np.ndarray
    lead: int
    behind: int
    share: float
    channel: int | None
    settling: np.ndarray


def before(drawn: Set, knobs: Knobs, commands: np.ndarray, lead: int | None = None) -> Before:
    """Return what lies before the first row.

    Args:
        drawn: the set.
        knobs: of its effects.
        commands: (B, rows, nu): of two rows more than are recorded; with `lead` from the first row on.
        lead: rows before it; None: as many as its sensors ask for.
    """
    system = SYSTEMS[drawn.system]
    commands = np.array(commands)
    behind, share, channel = _late_sensor(drawn, system, knobs)
    settling = _settling(system, drawn.effects, knobs)
    wanted = int(np.ceil(SETTLED * settling.max() / system.dt - 1e-9)) if settling.any() else 0
    if lead is not None or wanted:
        wanted = wanted if lead is None else lead
        commands = np.concatenate([np.repeat(commands[:, :1], wanted, axis=1), commands], axis=1)
    elif behind:
        commands[:, :behind] = commands[:, behind : behind + 1]
    return Before(commands, wanted or behind, behind, share, channel, settling)


def driven(
    drawn: Set, began: Before, parameters: dict[str, float], knobs: Knobs, start: np.ndarray,
    at: Callable[[float], dict[str, Any]] | None = None, **how: Any,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return what `simulate` does of a set's plant, with first states (B, nx) where `began` begins; at: as of `plant`."""
    system, effects = SYSTEMS[drawn.system], drawn.effects
    late, slow, play = (_of_inputs(system, effects, knobs, kind) for kind in (DELAY, LAG, PLAY))
    return simulate(
        plant(system, parameters, effects, knobs, at), start, began.commands, system.dt, delay=late, lag=slow, play=play,
        tap=began.share * system.dt, sensor_lag=began.settling, linear=nuisances.LINEAR in drawn.nuisances, **how,
    )  # fmt: skip


def read(drawn: Set, began: Before, knobs: Knobs, states: np.ndarray, tapped: np.ndarray) -> np.ndarray:
    """Return what noise-free sensors read, (B, ROWS, nx), of states and those a share of a row later."""
    rows = slice(began.lead, began.lead + ROWS)
    clean = _sensors(SYSTEMS[drawn.system], drawn.effects, knobs, states[:, rows])
    if (
        began.channel is not None
    ):  # a late sensor reads what was `share` of a row after the row before, or the one before it
        first = began.lead - began.behind
        clean[..., began.channel] = tapped[:, first : first + ROWS, began.channel]
    for i in np.flatnonzero(began.settling):
        clean[..., i] = tapped[:, rows, i]
    return clean


def plant(
    system: System,
    parameters: dict[str, float],
    effects: tuple[Effect, ...],
    knobs: tuple[dict[str, float], ...],
    at: Callable[[float], dict[str, Any]] | None = None,
) -> Rate:
    """Return the right-hand side with everything planted that acts on rates and inputs; at: parameters at a time."""

    def rate(x: np.ndarray, u: np.ndarray, t: float) -> np.ndarray:
        u = np.array(u)
        for effect, k in zip(effects, knobs, strict=True):
            if effect.kind == INPUT:
                j = system.inputs.index(effect.acts_on)
                u[..., j] = effect.formula(u[..., j], k)
        dx = system.rate(x, u, parameters if at is None else at(t))
        for effect, k in zip(effects, knobs, strict=True):
            if effect.kind not in (RATE, OWN_RATE):
                continue
            i = system.states.index(effect.acts_on)
            if effect.kind == OWN_RATE:
                dx[..., i] = effect.formula(dx[..., i], k, x)
            elif effect.name == "added_inertia":
                dx[..., i] /= 1 + k["alpha"]
            else:
                partner = system.velocity.get(effect.acts_on)
                other = system.states.index(partner) if partner else (1 - i if len(system.states) == 2 else i)
                dx[..., i] += effect.formula(x[..., i], x[..., other], t, k, x, u)
        return dx

    return rate


def _of_inputs(
    system: System, effects: tuple[Effect, ...], knobs: tuple[dict[str, float], ...], kind: str
) -> list[float]:
    found = dict.fromkeys(system.inputs, 0.0)
    for effect, k in zip(effects, knobs, strict=True):
        if effect.kind == kind:
            found[effect.acts_on] += next(iter(k.values()))
    return list(found.values())


def _settling(system: System, effects: tuple[Effect, ...], knobs: tuple[dict[str, float], ...]) -> np.ndarray:
    """Time constant of every state's sensor, s."""
    found = np.zeros(len(system.states))
    for effect, k in zip(effects, knobs, strict=True):
        if effect.kind == SLOW_SENSOR:
            found[system.states.index(effect.acts_on)] = k["tau"]
    return found


def _late_sensor(drawn: Set, system: System, knobs: Knobs) -> tuple[int, float, int | None]:
    """Rows in front of the record, share of a row at which the states are recorded once more, and the late channel."""
    if nuisances.LATE in drawn.nuisances:
        rows = nuisances.ROWS_LATE
        speed = system.states.index(next(iter(system.velocity)))
        return int(np.ceil(rows)), float(np.ceil(rows) - rows), speed
    for effect, k in zip(drawn.effects, knobs, strict=True):
        if effect.kind == LATE_SENSOR:
            rows = k["d"] / system.dt
            return int(np.ceil(rows - 1e-9)), float(np.ceil(rows - 1e-9) - rows), system.states.index(effect.acts_on)
    return 0, 0.0, None


def _sensors(
    system: System, effects: tuple[Effect, ...], knobs: tuple[dict[str, float], ...], true: np.ndarray
) -> np.ndarray:
    read = true.copy()
    for effect, k in zip(effects, knobs, strict=True):
        if effect.kind == SENSOR:
            i = system.states.index(effect.acts_on)
            read[..., i] = effect.formula(read[..., i], k)
    return read
