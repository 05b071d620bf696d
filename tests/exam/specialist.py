"""What somebody who knows the cause reaches on the sets of the first exam: `python -m tests.exam.specialist DIR --sets 100`.

The true structure is given, with everything that was planted, and the fit begins at the true values: an upper bound of what a
specialist can do. Parameters of the rig, sizes of the effects and first states minimise the simulation error of the training
episodes (scipy's least squares). The test is the protocol of `simpel discover`: the first state is fitted to the first rows
alone, errors are those of the rows behind, against what was measured. DIR holds an exam that was run; sets in MuJoCo are left
out, and so is what has nothing planted. The table has the errors of free runs of the calibrated simulator and of the corrected
one, in those of the specialist.
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from tests.exam.draw import DERIVED, ONE, TWO, Set, draw
from tests.exam.examine import RUN, places
from tests.exam.planted import LATE_SENSOR, SLOW_SENSOR
from tests.exam.plants import SYSTEMS
from tests.exam.record import TRAIN, Record, record
from tests.exam.rig import Knobs, before, driven, read

FIRST = 6  # rows that tell the first state of a test episode
STEP = 1e-4  # of the size of an unknown, for slopes
LEAD = 2  # rows before the first one that a late sensor may show; a fit moves its lateness
FITS = 60  # evaluations of a fit at most
FILE = "specialist.parquet"


class Unknown(NamedTuple):
    """An unknown of the true model: of the rig, `effect` None, or of an effect; bounds of its change, in sizes."""

    effect: int | None
    name: str
    size: float
    bounds: tuple[float, float] = (-np.inf, np.inf)


class Model(NamedTuple):
    """The true structure of a set, and what was measured of it; a speed that was derived from a position was not."""

    drawn: Set
    made: Record
    unknowns: tuple[Unknown, ...]
    names: tuple[str, ...]

    @property
    def columns(self) -> list[int]:
        """Where what was measured stands among the states."""
        return [SYSTEMS[self.drawn.system].states.index(name) for name in self.names]

    def simulated(self, at: np.ndarray, start: np.ndarray, episodes: slice) -> np.ndarray:
        """Return what noise-free sensors read, (B, ROWS, ny), from first states (B, nx), in standard deviations of noise."""
        parameters, knobs = dict(self.made.parameters), [dict(k) for k in self.made.knobs]
        for unknown, value in zip(self.unknowns, at, strict=True):
            of = parameters if unknown.effect is None else knobs[unknown.effect]
            of[unknown.name] += value * unknown.size
        sensors = [e.kind in (LATE_SENSOR, SLOW_SENSOR) for e in self.drawn.effects]
        lead = before(self.drawn, self.made.knobs, self.made.commands).lead if any(sensors) else 0
        began = before(self.drawn, tuple(knobs), self.made.commands[episodes], max(lead, LEAD) if lead else 0)
        with np.errstate(all="ignore"):
            states, tapped, _ = driven(self.drawn, began, parameters, tuple(knobs), start)
        clean = read(self.drawn, began, tuple(knobs), states, tapped)[..., self.columns]
        return clean / self.made.noise[self.columns]


def unknowns_of(drawn: Set, parameters: Mapping[str, float], knobs: Knobs) -> tuple[Unknown, ...]:
    """Return the parameters of the rig, within the ranges that the tool is told, and of the effects without widths of ramps."""
    rig = []
    for name, (low, high) in SYSTEMS[drawn.system].ranges.items():
        wide = high - low
        rig.append(Unknown(None, name, wide, ((low - parameters[name]) / wide, (high - parameters[name]) / wide)))
    planted = [
        Unknown(i, name, abs(value) or 1.0)
        for i, (effect, own) in enumerate(zip(drawn.effects, knobs, strict=True))
        for name, value in own.items()
        if name in effect.sized or not name.startswith("_") or name == "_most"
    ]
    return (*rig, *planted)


def model_of(drawn: Set) -> Model:
    """Return the true structure of a set."""
    made = record(drawn)
    system = SYSTEMS[drawn.system]
    names = tuple(n for n in drawn.measured if drawn.condition != DERIVED or n not in system.velocity)
    return Model(drawn, made, unknowns_of(drawn, made.parameters, made.knobs), names)


def fitted(model: Model) -> np.ndarray:
    """Return by how many of their sizes the unknowns differ from the truth, where the simulation error is least."""
    episodes, size = slice(0, TRAIN), _spread(model)
    seen = _seen(model, episodes)
    count, shape = len(model.unknowns), (TRAIN, len(size))

    def residual(at: np.ndarray) -> np.ndarray:
        start = model.made.true[episodes, 0] + at[count:].reshape(shape) * size
        return _finite(model.simulated(at[:count], start, episodes) - seen)

    def slopes(at: np.ndarray) -> np.ndarray:
        still = residual(at).reshape(TRAIN, -1)
        found = np.zeros((TRAIN, still.shape[1], len(at)))
        for i in range(count):
            moved = at.copy()
            moved[i] += STEP
            found[:, :, i] = (residual(moved).reshape(TRAIN, -1) - still) / STEP
        for j in range(shape[1]):  # the first states of all episodes at once
            moved = at.copy()
            moved[count + j :: shape[1]] += STEP
            change = (residual(moved).reshape(TRAIN, -1) - still) / STEP
            for e in range(TRAIN):
                found[e, :, count + e * shape[1] + j] = change[e]
        return found.reshape(-1, len(at))

    free = np.full(TRAIN * shape[1], np.inf)
    low, high = (
        np.concatenate([[u.bounds[side] for u in model.unknowns], sign * free]) for side, sign in ((0, -1), (1, 1))
    )
    return least_squares(residual, np.zeros(len(free) + count), slopes, bounds=(low, high), max_nfev=FITS).x[:count]


def tested(model: Model, at: np.ndarray) -> np.ndarray:
    """Return root mean squares, (ny,), of the errors of free runs behind the first rows of the test episodes, in their unit."""
    size, errors = _spread(model), []
    for e in range(TRAIN, len(model.made.true)):
        one = slice(e, e + 1)
        seen, begin = _seen(model, one), model.made.true[one, 0]

        def missed(x: np.ndarray, one: slice = one, seen: np.ndarray = seen, begin: np.ndarray = begin) -> np.ndarray:
            return (model.simulated(at, begin + x * size, one) - seen)[0]

        first: Callable[[np.ndarray], np.ndarray] = lambda x, missed=missed: _finite(missed(x)[:FIRST])  # noqa: E731
        best = least_squares(first, np.zeros(len(size)), max_nfev=FITS).x
        errors.append(missed(best)[FIRST:] * model.made.noise[model.columns])
    return np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))


def _spread(model: Model) -> np.ndarray:
    return model.made.true[:TRAIN].std(axis=(0, 1))


def _seen(model: Model, episodes: slice) -> np.ndarray:
    return model.made.measured[episodes][..., model.columns] / model.made.noise[model.columns]


def _finite(error: np.ndarray) -> np.ndarray:
    return np.nan_to_num(error, nan=0.0, posinf=1e6, neginf=-1e6).ravel()


def compared(out: Path, index: int, seed: int) -> dict[str, object] | None:
    """Return the row of a set; None where it has nothing planted that the exam's own plants do, or was not run."""
    drawn, path = draw(index, seed), places(out, index)[0] / RUN / "verdict.json"
    if drawn.kind not in (ONE, TWO) or drawn.world != "own" or not path.exists():
        return None
    error, began = json.loads(path.read_text())["error"], time.perf_counter()
    model = model_of(drawn)
    least = tested(model, fitted(model))

    def times(side: str) -> float:
        ours = [error[side]["free_run"][name] for name in model.names]
        return float(np.exp(np.mean(np.log(np.array(ours, float) / least))))

    return {
        "index": index, "system": drawn.system, "kind": drawn.kind, "condition": drawn.condition, "noise": drawn.noise,
        "planted": "+".join(drawn.planted), "before": times("before"), "after": times("after"),
        "least": json.dumps(dict(zip(model.names, least, strict=True))), "seconds": time.perf_counter() - began,
    }  # fmt: skip


def main() -> None:
    """Fit, keep and print."""
    parser = argparse.ArgumentParser(prog="tests.exam.specialist", description=__doc__)
    parser.add_argument("out", type=Path, metavar="DIR")
    parser.add_argument("--sets", type=int, default=600, help="of the exam, the first so many")
    options = parser.parse_args()
    plan = json.loads((options.out / "exam.json").read_text())
    if plan["second"]:
        parser.error(f"{options.out} holds the second exam, whose nuisances are no part of a specialist's equations")
    rows = []
    for index in range(min(options.sets, plan["sets"])):
        row = compared(options.out, index, plan["seed"])
        if row is not None:
            rows.append(row)
            print(f"{row['index']} {row['system']} {row['planted']} {row['before']:.3g} {row['after']:.3g}", flush=True)
    table = pd.DataFrame(rows)
    table.to_parquet(options.out / FILE)
    print(report(table))


def report(table: pd.DataFrame) -> str:
    """Return medians of errors of a free run, in those of the specialist; with nine in ten below."""
    lines = [
        "| sets | n | calibrated simulator | simpel | nine in ten below | at most 1.05 | at most 1.3 |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, part in [("all", table), *table.groupby("system"), *table.groupby("condition")]:
        after = part.after.to_numpy(float)
        shares = [f"{int((after <= most).sum())}/{len(after)}" for most in (1.05, 1.3)]
        lines.append(
            f"| {name} | {len(part)} | {part.before.median():.2f} | {np.median(after):.3f} | "
            f"{np.quantile(after, 0.9):.2f} | {shares[0]} | {shares[1]} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
