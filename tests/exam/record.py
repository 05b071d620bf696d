"""From a set to what its sensors read: plant, episodes, sensors, noise. Of this the tool gets what was measured only."""

from typing import Any, NamedTuple

import numpy as np

from tests.exam import mujoco_plants, nuisances
from tests.exam.draw import CLOSED, DERIVED, NONE, OUTLIERS, QUANTISED, SHAKEN, Set
from tests.exam.integrate import simulate
from tests.exam.plants import SYSTEMS, System
from tests.exam.rig import ROWS, before, driven, plant, read
from tests.exam.twins import twins

TRAIN, TEST = 5, 2
PROCESS = 0.02  # of a rate's standard deviation times the square root of a row: what one row adds of process noise
OUTLIER_SHARE, OUTLIER_SIZE = 0.02, 12.0  # of the rows; of the noise
STEP = 2.0  # of the noise: the least digit of a quantised sensor
DITHER = 0.1  # of the input's range, on top of a controller's command


class Record(NamedTuple):
    """Noise-free and measured channels.

    Args:
        true: (B, rows, nx) states.
        clean: (B, rows, nx) what noise-free sensors read.
        measured: (B, rows, nx) what the sensors read.
        commands: (B, rows, nu).
        noise: (nx,) standard deviation that was added.
        parameters: true ones of the simulator.
        knobs: true ones of every effect.
    """

    true: np.ndarray
    clean: np.ndarray
    measured: np.ndarray
    commands: np.ndarray
    noise: np.ndarray
    parameters: dict[str, float]
    knobs: tuple[dict[str, float], ...]


def record(drawn: Set) -> Record:
    """Run the episodes of a set and measure them."""
    system, random = SYSTEMS[drawn.system], np.random.default_rng(drawn.seed)
    parameters = system.parameters(random)
    effects, knobs = drawn.effects, tuple(e.knobs(s) for e, s in zip(drawn.effects, drawn.strength, strict=True))
    count = TRAIN + TEST
    start, commands = system.start(random, count), system.commands(random, count, ROWS + 2)
    seconds = ROWS * system.dt
    _, at = nuisances.parameters_of(drawn.nuisances, random_of(drawn, 1), parameters, count, seconds)
    controller = _controller(system, random, count) if drawn.condition == CLOSED else None
    began = before(drawn, knobs, commands)
    diffusion = None
    if drawn.condition == SHAKEN:
        quiet, _, _ = simulate(plant(system, parameters, effects, knobs), start, began.commands, system.dt)
        spread = (np.diff(quiet, axis=1) / system.dt).std(axis=(0, 1))
        moved = np.array([name in system.driven for name in system.states])
        diffusion = np.where(moved, PROCESS * spread * np.sqrt(system.dt), 0.0)
    if drawn.world == "mujoco":
        model = mujoco_plants.world(
            drawn.system, parameters, *((effects[0].name, knobs[0]) if effects else ("", {})), system.dt
        )
        states, commands = mujoco_plants.simulate(model, start, began.commands, controller)
        tapped = states
    else:
        states, tapped, commands = driven(
            drawn, began, parameters, knobs, start, at, controller=controller, diffusion=diffusion, random=random
        )
    rows = slice(began.lead, began.lead + ROWS)
    true, given = states[:, rows], commands[:, rows]
    clean = read(drawn, began, knobs, states, tapped)
    noise = drawn.noise * clean[:TRAIN].std(axis=(0, 1))
    measured = clean + noise * nuisances.noise_of(drawn.nuisances, random, clean.shape)
    measured = nuisances.faulty(drawn.nuisances, system, measured, noise, random_of(drawn, 2))
    return Record(true, clean, _faults(drawn, system, measured, noise, random), given, noise, parameters, knobs)


def random_of(drawn: Set, use: int) -> np.random.Generator:
    """Return random numbers of a set that are no others': a nuisance changes nothing else of it."""
    return np.random.default_rng((drawn.seed, use))


def truth(drawn: Set, made: Record) -> dict[str, Any]:
    """Return what an answer is compared with."""
    position_only = len(drawn.measured) < len(SYSTEMS[drawn.system].states)
    effects = [
        {
            "name": e.name, "acts_on": e.acts_on, "accept": list(e.accept) or [e.name], "strength": s,
            "parameters": {n: v for n, v in k.items() if not n.startswith("_")} if e.group == "one" else {},
            "twins": twins(drawn.system, e.key, position_only=position_only),
        }
        for e, s, k in zip(drawn.effects, drawn.strength, made.knobs, strict=True)
    ]  # fmt: skip
    absorbed = drawn.kind == NONE and bool(effects)
    ranges = SYSTEMS[drawn.system].ranges
    absent = nuisances.parameters_of(drawn.nuisances, random_of(drawn, 1), made.parameters, 1, 1.0)[0]
    return {n: v for n, v in drawn._asdict().items() if n not in ("planted", "strength")} | {
        "effects": [] if drawn.kind == NONE else effects,
        "absorbed": effects if absorbed else [],
        "measured": list(drawn.measured),
        # of what is planted in MuJoCo, or taken in by them, the parameters that fit are others
        "parameters": {}
        if absorbed
        else {n: {"value": v, "range": ranges[n]} for n, v in made.parameters.items() if n != absent},
        "may_be": sorted(nuisances.may_be(drawn.nuisances, SYSTEMS[drawn.system])),
    }


def _faults(drawn: Set, system: System, y: np.ndarray, noise: np.ndarray, random: np.random.Generator) -> np.ndarray:
    if drawn.condition == OUTLIERS:
        hit = random.random(y.shape) < OUTLIER_SHARE
        y = y + hit * random.choice([-1.0, 1.0], y.shape) * OUTLIER_SIZE * random.uniform(0.7, 1.5, y.shape) * noise
    if drawn.condition == QUANTISED:
        y = np.round(y / (STEP * noise)) * STEP * noise
    if drawn.condition == DERIVED:
        for velocity, position in system.velocity.items():
            column = y[..., system.states.index(position)]
            y[..., system.states.index(velocity)] = np.gradient(column, system.dt, axis=1)
    return y


def _controller(system: System, random: np.random.Generator, count: int) -> Any:
    """Feedback from the true state to a reference that steps, with a little dither, cut to the input's limits."""
    lengths = random.integers(8, 20)
    wanted = np.repeat(random.uniform(-1, 1, (count, ROWS + 2, len(system.inputs))), lengths, axis=1)[:, : ROWS + 2]
    low, high = np.array(system.limits).T
    dither = DITHER * (high - low) * random.standard_normal((count, ROWS + 2, len(system.inputs)))

    def control(x: np.ndarray, row: int) -> np.ndarray:
        episodes = slice(None) if len(x) == count else slice(0, len(x))
        return np.clip(system.feedback(x, wanted[episodes, row]) + dither[episodes, row], low, high)

    return control
