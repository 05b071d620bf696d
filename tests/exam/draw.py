"""What a set of the exam is: a system, what is planted and how strong, how it is measured; drawn by number and seed."""

from typing import NamedTuple

import numpy as np

from tests.exam import nuisances
from tests.exam.mujoco_plants import can
from tests.exam.planted import (
    ABSORBED,
    EFFECTS,
    INPUT,
    LATE_SENSOR,
    ONE,
    OWN_RATE,
    RATE,
    SENSOR,
    SLOW_SENSOR,
    Effect,
    by_key,
)
from tests.exam.plants import SYSTEMS
from tests.exam.twins import apart

FULL, POSITION, CLOSED, SHAKEN = "full", "position only", "closed loop", "process noise"
OUTLIERS, QUANTISED, DERIVED = "outliers", "quantised", "derived velocity"
NONE, TWO, SHAPE, OUTSIDE = "none", "two", "shape", "outside"

SHARE_OF_SYSTEM = {"pendulum": 0.27, "cart": 0.23, "tanks": 0.17, "thermal": 0.17, "car": 0.16}
SHARE_OF_KIND = {NONE: 0.33, ONE: 0.43, TWO: 0.08, SHAPE: 0.08, OUTSIDE: 0.08}
SHARE_OF_CONDITION = {
    FULL: 0.37, POSITION: 0.15, CLOSED: 0.12, SHAKEN: 0.12, OUTLIERS: 0.08, QUANTISED: 0.08, DERIVED: 0.08,
}  # fmt: skip
NOISE = (0.003, 0.01, 0.03)
DECADES = {ONE: 2.0, SHAPE: 1.0, OUTSIDE: 1.0, TWO: 0.7, NONE: 0.0}  # over which strengths are log-uniform
IN_MUJOCO = {ONE: 0.9, NONE: 0.4}  # of the sets that MuJoCo can do
ABSORBED_SHARE = 0.2  # of the sets with nothing to find, where the system has such an effect


class Set(NamedTuple):
    """One set.

    Args:
        index: number in the exam.
        system: of SYSTEMS.
        kind: none, one, two, shape or outside.
        planted: keys `name@place` of effects; for kind none empty, or one that the parameters take in.
        strength: of each, within 0..1.
        noise: standard deviation, in standard deviations of each channel.
        condition: how it was measured and driven.
        world: own or mujoco.
        seed: of everything that is random in its data.
        nuisances: of the second exam: what its measurements are like beside their noise.
    """

    index: int
    system: str
    kind: str
    planted: tuple[str, ...]
    strength: tuple[float, ...]
    noise: float
    condition: str
    world: str
    seed: int
    nuisances: tuple[str, ...] = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """What is planted."""
        return tuple(by_key(self.system, key) for key in self.planted)

    @property
    def measured(self) -> tuple[str, ...]:
        """Channels that the tool gets."""
        system = SYSTEMS[self.system]
        return system.position if self.condition == POSITION else system.states


def draw(index: int, seed: int) -> Set:
    """Draw set number `index` of the exam `seed`."""
    random = np.random.default_rng((seed, index))
    system = _pick(random, SHARE_OF_SYSTEM)
    kind = _pick(random, SHARE_OF_KIND)
    effects = _planted(random, system, kind)
    condition = _pick(random, SHARE_OF_CONDITION)
    if not possible(system, condition, effects):
        condition = FULL
    mechanism = effects[0].name if len(effects) == 1 else ""
    mujoco = condition != SHAKEN and can(system, mechanism) and (not effects or effects[0].group == ONE)
    return Set(
        index, system, kind, tuple(e.key for e in effects),
        tuple(float(10 ** -random.uniform(0, DECADES[kind])) for _ in effects),
        float(random.choice(NOISE)), condition,
        "mujoco" if random.random() < IN_MUJOCO.get(kind, 0.0) * mujoco else "own",
        int(random.integers(2**31)),
    )  # fmt: skip


def draw_second(index: int, seed: int) -> Set:
    """Draw set number `index` of the second exam `seed`: own systems, everything measured, with nuisances."""
    drawn = draw(index, seed)._replace(condition=FULL, world="own")
    random = np.random.default_rng((seed, index, 2))
    return drawn._replace(nuisances=nuisances.drawn(random, SYSTEMS[drawn.system], drawn.effects))


def possible(system: str, condition: str, effects: tuple[Effect, ...]) -> bool:
    """Whether a system can be measured so with this planted."""
    told = SYSTEMS[system]
    if condition == DERIVED:
        return bool(told.velocity) and not any(e.both for e in effects)
    if condition == POSITION:
        if not apart(system, tuple(e.key for e in effects), position_only=True):
            return False
        return not any(e.both or (e.kind == SENSOR and e.acts_on not in told.position) for e in effects)
    return condition != CLOSED or not any(e.kind in (LATE_SENSOR, SLOW_SENSOR) for e in effects)


def _planted(random: np.random.Generator, system: str, kind: str) -> tuple[Effect, ...]:
    effects = EFFECTS[system]
    if kind == NONE:
        absorbed = [e for e in effects if e.group == ABSORBED]
        return (absorbed[random.integers(len(absorbed))],) if absorbed and random.random() < ABSORBED_SHARE else ()
    if kind == TWO:
        of_rate = [e for e in effects if e.group == ONE and e.kind == RATE and e.name != "added_inertia"]
        of_input = [e for e in effects if e.group == ONE and e.kind not in (RATE, OWN_RATE, SENSOR) and not e.both]
        of_input += [e for e in effects if e.group == ONE and e.kind == INPUT and e.name == "input_dead_zone"]
        while True:
            pair = of_rate[random.integers(len(of_rate))], of_input[random.integers(len(of_input))]
            if apart(system, tuple(e.key for e in pair), position_only=False):
                return pair
    pool = [e for e in effects if e.group == kind]
    names = sorted({e.name for e in pool})
    name = names[random.integers(len(names))]
    places = [e for e in pool if e.name == name]
    return (places[random.integers(len(places))],)


def _pick(random: np.random.Generator, shares: dict[str, float]) -> str:
    weights = np.array(list(shares.values()))
    return str(random.choice(list(shares), p=weights / weights.sum()))
