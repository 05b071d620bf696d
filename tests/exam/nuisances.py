"""What the measurements of real rigs are like beside their noise: the second exam draws one to three of these per set.

A nuisance is no missing effect. A tool may say what it is (`NAMED`), and some are effects of a sensor, which it may name so
(`MAY_BE`); everything else that it claims beside what is planted is false.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from tests.exam.planted import LATE_SENSOR, PLAY, SENSOR, SLOW_SENSOR, Effect
from tests.exam.plants import System

LINEAR, HEAVY, COARSE, GAPS = "linear inputs", "heavy tails", "quantised", "gaps"
LATE, FILTERED, OFFSET = "late speed", "filtered speed", "offset"
DIFFERING, DRIFT = "differing parameter", "drift"
ALL = (LINEAR, HEAVY, COARSE, GAPS, LATE, FILTERED, OFFSET, DIFFERING, DRIFT)
MOST = 3
APART = ((LATE, FILTERED), (DIFFERING, DRIFT), (HEAVY, COARSE))  # never both: one hides the other

TAILS = 3.0  # degrees of freedom
STEP = 3.0  # of the noise: the least digit
MISSING, ABSENT = 0.1, 0.03  # of the values; of the rows
ROWS_LATE = 1.3
SMOOTHED = 1.5  # rows: time constant of the filter behind a differentiated position
OFF = 4.0  # of the noise
DIFFERS = 0.12  # standard deviation between episodes, of the parameter
DRIFTS = 0.15  # over an episode, of the parameter


def drawn(random: np.random.Generator, system: System, effects: tuple[Effect, ...]) -> tuple[str, ...]:
    """Draw nuisances that a system with this planted can have."""
    left = [n for n in ALL if possible(n, system, effects)]
    found: list[str] = []
    for _ in range(random.integers(1, MOST + 1)):
        left = [n for n in left if n not in found and not any(n in p and set(p) & set(found) for p in APART)]
        found += [left[random.integers(len(left))]] if left else []
    return tuple(found)


def possible(name: str, system: System, effects: tuple[Effect, ...]) -> bool:
    """Whether a system with this planted can have a nuisance."""
    sensors = any(e.kind in (SENSOR, LATE_SENSOR, SLOW_SENSOR) or e.both for e in effects)
    if name in (LATE, FILTERED):
        return bool(system.velocity) and not sensors
    if name == OFFSET:
        return not sensors
    return name != LINEAR or not any(e.kind == PLAY for e in effects)


def parameters_of(
    nuisances: tuple[str, ...], random: np.random.Generator, parameters: dict[str, float], count: int, seconds: float
) -> tuple[str, Callable[[float], dict[str, Any]]]:
    """Return the parameter that is no constant, if one is not, and all of them at a time: a number, or one per episode."""
    name = str(random.choice(sorted(parameters)))
    differs, sign = 1 + DIFFERS * random.standard_normal(count), random.choice([-1.0, 1.0])

    def at(t: float) -> dict[str, Any]:
        factor: Any = differs if DIFFERING in nuisances else 1 + sign * DRIFTS * (t / seconds - 0.5)
        return parameters | {name: parameters[name] * factor}

    told = DIFFERING in nuisances or DRIFT in nuisances
    return (name, at) if told else ("", lambda _: parameters)


def noise_of(nuisances: tuple[str, ...], random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return noise of variance 1."""
    if HEAVY in nuisances:
        return random.standard_t(TAILS, shape) / np.sqrt(TAILS / (TAILS - 2))
    return random.standard_normal(shape)


def faulty(
    nuisances: tuple[str, ...], system: System, y: np.ndarray, noise: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Return what is written of what the sensors read, (B, rows, nx); NaN: nothing."""
    y = y.copy()
    if OFFSET in nuisances:
        i = system.states.index(system.position[-1])
        y[..., i] += OFF * noise[i]
    if FILTERED in nuisances:
        for velocity, position in system.velocity.items():
            slope = np.gradient(y[..., system.states.index(position)], system.dt, axis=1)
            y[..., system.states.index(velocity)] = _smoothed(slope, np.exp(-1 / SMOOTHED))
    if COARSE in nuisances:
        y = np.round(y / (STEP * noise)) * STEP * noise
    if GAPS in nuisances:
        y[random.random(y.shape) < MISSING] = np.nan
        y[random.random(y.shape[:2]) < ABSENT] = np.nan
    return y


def _smoothed(values: np.ndarray, keeps: float) -> np.ndarray:
    found = values.copy()
    for k in range(1, values.shape[1]):
        found[:, k] = keeps * found[:, k - 1] + (1 - keeps) * values[:, k]
    return found


def may_be(nuisances: tuple[str, ...], system: System) -> set[tuple[str, str]]:
    """Return the effects of sensors, with their places, as which the nuisances may be named."""
    speeds = {
        (name, place)
        for place in system.velocity
        for name in ("sensor_delay", "sensor_lag")
        if {LATE, FILTERED} & {*nuisances}
    }
    return speeds | ({("sensor_bias", p) for p in system.position} if OFFSET in nuisances else set())


def named(nuisances: tuple[str, ...], system: System, found: Mapping[str, Any]) -> dict[str, bool]:
    """Return whether the tool says of each nuisance what it is; those that no tool has to name are left out."""
    claimed = {(m["name"], m["acts_on"]) for e in found["effects"] for m in e["class_members"]}
    bad = {c["check"] for c in found["data_checks"] if not c["ok"]}
    drift = found.get("drift") or {"how": ""}
    differing = any(g["parameter"] and g["pays"] for g in found["grouping"]) or "to episode" in drift["how"]
    left = found["remainder"] or {"depends_on": [], "description": ""}
    speeds = {(n, p) for p in system.velocity for n in ("sensor_delay", "sensor_lag")}
    says = {
        LINEAR: any(p["word"] == "linear" for p in found["between_rows"].values()),
        HEAVY: bool(found["degrees_of_freedom"]),
        LATE: bool(claimed & speeds) or bool(bad & {"kinematics"}),
        FILTERED: bool(claimed & speeds) or bool(bad & {"kinematics", "derived"}),
        DIFFERING: differing,
        DRIFT: "time" in left["depends_on"] or "over an episode" in drift["how"],
    }
    return {n: says[n] for n in nuisances if n in says}
