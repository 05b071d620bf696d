"""Sets of the blind exam: measurements of a pendulum with at most one planted effect, and the truth apart from them.

Nothing here is simpel's: own right-hand side, own integrator (RK4, 8 steps per row), own formulas of the effects.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

DT, ROWS, FINE = 0.05, 60, 8
EFFECTS = ("viscous_friction", "coulomb_friction", "quadratic_drag", "constant_load", "input_delay", "input_dead_zone")
LARGEST = {
    "viscous_friction": 0.8, "coulomb_friction": 2.0, "quadratic_drag": 0.3, "constant_load": 2.0, "input_delay": 0.12,
    "input_dead_zone": 0.8,
}  # fmt: skip
ACTS_ON = {"input_delay": "u", "input_dead_zone": "u"}


class Set(NamedTuple):
    """One set: what is planted and how it is measured."""

    effect: str  # "" for none
    strength: float
    noise: float  # of each channel's standard deviation
    measured: tuple[str, ...]
    seed: int


def draw(index: int, seed: int) -> Set:
    """Draw set number `index` of an exam: a third have no effect; strengths are log-uniform over two decades."""
    random = np.random.default_rng((seed, index))
    effect = "" if random.random() < 0.34 else str(random.choice(EFFECTS))
    strength = LARGEST.get(effect, 0.0) * 10 ** random.uniform(-2, 0)
    measured = ("phi", "omega") if random.random() < 0.7 else ("phi",)
    return Set(effect, strength, float(random.choice([0.003, 0.01, 0.03])), measured, int(random.integers(2**31)))


def write(drawn: Set, folder: Path, truth: Path) -> None:
    """Write `run.parquet` and the data YAML into `folder`, the truth to a file elsewhere."""
    random = np.random.default_rng(drawn.seed)
    m, length, motor = random.uniform(0.7, 1.3), random.uniform(0.7, 1.3), random.uniform(0.9, 1.1)
    tables = []
    for episode in range(7):
        u = np.repeat(random.uniform(-2.5, 2.5, ROWS), random.integers(2, 9))[:ROWS]
        x = np.array([random.uniform(-np.pi, np.pi), random.uniform(-1, 1)])
        states = _integrate(
            _plant(drawn, m, length, motor), x, u, drawn.strength if drawn.effect == "input_delay" else 0.0
        )
        tables.append(
            pd.DataFrame(
                {"episode": episode, "t": np.arange(ROWS) * DT, "phi": states[:, 0], "omega": states[:, 1], "u": u}
            )
        )
    table = pd.concat(tables, ignore_index=True)
    for name in ("phi", "omega"):
        table[name] += drawn.noise * table[name].std() * random.standard_normal(len(table))
    table["split"] = np.where(table.episode < 5, "train", "test")
    (folder / "data").mkdir(parents=True)
    table.drop(columns=[n for n in ("phi", "omega") if n not in drawn.measured]).to_parquet(
        folder / "data" / "run.parquet"
    )
    columns = "{}" if "omega" in drawn.measured else "{omega: null}"
    (folder / "data" / "exam.yaml").write_text(
        f"path: run.parquet\ntime: t\nepisode: episode\ncolumns: {columns}\nsplit: {{column: split}}\n"
    )
    truth.parent.mkdir(parents=True, exist_ok=True)
    truth.write_text(json.dumps(drawn._asdict() | {"acts_on": ACTS_ON.get(drawn.effect, "omega")}))


def _plant(drawn: Set, m: float, length: float, motor: float) -> Callable[[np.ndarray, float], np.ndarray]:
    k = drawn.strength

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        angle, speed = x
        if drawn.effect == "input_dead_zone":
            u = np.sign(u) * max(abs(u) - k, 0.0)
        push = 9.81 / length * np.sin(angle) + motor * u / (m * length**2)
        push -= {
            "viscous_friction": k * speed,
            "coulomb_friction": k * np.clip(speed / 0.01, -1, 1),  # a ramp, not the tool's tanh
            "quadratic_drag": k * speed * abs(speed),
            "constant_load": k,
        }.get(drawn.effect, 0.0)
        return np.array([speed, push])

    return rate


def _integrate(rate: Callable, x: np.ndarray, u: np.ndarray, delay: float) -> np.ndarray:
    h, states = DT / FINE, []
    for i in range(len(u)):
        states.append(x)
        for j in range(FINE):
            at = i * DT + (j + 0.5) * h - delay
            held = u[max(int(np.floor(at / DT)), 0)]
            k1 = rate(x, held)
            k2 = rate(x + h / 2 * k1, held)
            k3 = rate(x + h / 2 * k2, held)
            k4 = rate(x + h * k3, held)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.array(states)
