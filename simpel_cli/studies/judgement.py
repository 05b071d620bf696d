"""Test posteriors on held-out episodes and write the tables of the results."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli import evaluation as ev
from simpel_cli.data import Episode, Places, origins, places, transitions, with_measured_targets
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.runs.files import write_table
from simpel_cli.studies.open import Study, refuse_untested

MOST_RUNS = 100  # free runs that are kept in full


class Judged(NamedTuple):
    """What an evaluation found, for the terminal."""

    rows: list[dict[str, Any]]  # metric rows of all seeds
    blocks: str
    horizon: float | None  # s, of the free runs; None: no episode is long enough
    noise_std: np.ndarray  # learned, per seed and target, (seeds, dy), data units
    distinct: list[float]  # effective number of different particles, per seed


def judge(study: Study, posteriors: list[ev.Posterior], target_std: np.ndarray, directory: Path, step: int) -> Judged:
    """Evaluate the posterior of every seed on the test split.

    Writes `predictions.parquet`, `calibration.parquet`, `horizon.parquet` and `trajectories.parquet` into `directory`.

    Args:
        study: what was fitted, with the measurements to test it on.
        posteriors: one per seed.
        target_std: spread of the targets over the simulator's ranges, data units, shape (dy,).
        directory: of the run.
        step: that the posteriors are of.
    """
    encoding, dt = study.system.encoding, study.system.source.dt
    horizon = study.evaluation.steps(dt)
    episodes = study.recording.test
    refuse_untested(study.recording)
    pairs = with_measured_targets(transitions(episodes, encoding.stack, encoding.linear), episodes)
    x, y = ev.test_arrays(pairs, encoding)
    where = _places(study, episodes, pairs.episode, pairs.row)
    blocks = _blocks(study, episodes, where, horizon)
    follow = tuple(e for e in episodes if e.next_states is None)
    # the longest roll-out that an episode has room for
    horizon = min(horizon, max((len(e.states) - 1 - encoding.stack for e in follow), default=0))
    tables: dict[str, list[dict[str, np.ndarray]]] = {
        "predictions": [],
        "calibration": [],
        "horizon": [],
        "trajectories": [],
    }
    rows: list[dict[str, Any]] = []
    distinct = [ev.distinct_particles(posterior, x) for posterior in posteriors]
    run = None
    for seed, posterior, number in zip(study.settings.all_seeds, posteriors, distinct, strict=True):
        result = ev.one_step(posterior, x, y, pairs.weight[:, encoding.quantity_of_target])
        found = ev.one_step_table(result, blocks, encoding, target_std)
        found.append({"metric": "distinct_particles", "output": "joint", "unit": "1", "value": number})
        tables["predictions"].append(_predictions(seed, where, y, result, encoding))
        tables["calibration"].append(_calibration(seed, result, encoding))
        run = ev.free_run(posterior, encoding, follow, horizon) if horizon else None
        if run is not None:
            starts = _places(study, follow, run.episode, run.row)
            found += ev.free_run_table(run, _blocks(study, follow, starts, horizon), encoding, dt)
            tables["horizon"].append(_horizon(seed, run, encoding, dt))
            tables["trajectories"].append(_trajectories(seed, run, study, follow))
        rows += [{"seed": seed, "step": step, "split": "test", **row} for row in found]
    for name, parts in tables.items():
        if parts:
            write_table(directory / f"{name}.parquet", {k: np.concatenate([p[k] for p in parts]) for k in parts[0]})
    noise_std = np.stack([ev.noise_of(posterior, encoding) for posterior in posteriors])
    return Judged(rows, str(blocks), horizon * dt if run is not None else None, noise_std, distinct)


def _places(study: Study, episodes: Sequence[Episode], index: np.ndarray, row: np.ndarray) -> Places:
    """Where rows of test episodes come from."""
    of = origins((*study.recording.train, *study.recording.test))
    return places(episodes, of, index, row)


def _blocks(study: Study, episodes: Sequence[Episode], where: Places, horizon: int) -> ev.Blocks:
    """What the bootstrap resamples: single rows where they stand alone, else episodes, or windows of the horizon."""
    encoding, dt = study.system.encoding, study.system.source.dt
    if not encoding.states and not encoding.stack and len(set(where.episode)) < ev.MIN_EPISODES:
        return ev.Blocks(np.arange(len(where.row)), "rows")
    if any(episode.next_states is not None for episode in episodes):
        return ev.blocks_of(where.episode, where.row, horizon, "rows")  # their time may be unknown
    return ev.blocks_of(where.episode, where.time, horizon * dt, "s")


def _predictions(
    seed: int, where: Places, y: np.ndarray, result: ev.OneStep, encoding: Encoding
) -> dict[str, np.ndarray]:
    """One row per test transition and output: measured and predicted target with its bands.

    `episode` is the user's name; `segment` counts the pieces that checks or splits cut it into, `row` the rows of the
    piece; `time` is that of the measurement that the step starts from; `kind` is `change` in one step or `value`.
    """
    n, dy = y.shape
    return {
        "seed": np.full(n * dy, seed),
        "episode": np.repeat(where.episode, dy),
        "segment": np.repeat(where.segment, dy),
        "row": np.repeat(where.row, dy),
        "time": np.repeat(where.time, dy),
        "output": np.tile(encoding.y_names, n),
        "kind": np.tile(encoding.y_kinds, n),
        "unit": np.tile(encoding.y_units, n),
        "measured": y.ravel(),
        "mean": result.mean.ravel(),
        "std": result.std.ravel(),
        "epistemic_std": result.epistemic_std.ravel(),
    }


def _calibration(seed: int, result: ev.OneStep, encoding: Any) -> dict[str, np.ndarray]:
    """Fraction of targets inside the central region of every level, per output and jointly."""
    names = np.array([*encoding.y_names, "joint"])
    fraction = result.below.mean(axis=0)
    return {
        "seed": np.full(fraction.size, seed),
        "output": np.repeat(names, len(ev.LEVELS)),
        "level": np.tile(ev.LEVELS, len(names)),
        "fraction": fraction.ravel(),
    }


def _horizon(seed: int, run: ev.FreeRun, encoding: Any, dt: float) -> dict[str, np.ndarray]:
    """Root mean square error of free runs, and the spread that the posterior predicts, by horizon and state."""
    rmse, claimed = _root_mean(run.error, run.known), np.sqrt((run.std**2).mean(axis=0))
    steps, ds = rmse.shape
    return {
        "seed": np.full(steps * ds, seed),
        "horizon": np.repeat(np.arange(steps) * dt, ds),
        "output": np.tile([q.name for q in encoding.states], steps),
        "unit": np.tile([q.unit for q in encoding.states], steps),
        "rmse": rmse.ravel(),
        "claimed_std": claimed.ravel(),
    }


def _root_mean(a: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Root mean square over the runs whose state was measured, (H + 1, ds); NaN where none was."""
    count = known.sum(axis=0)
    with np.errstate(invalid="ignore"):
        found: np.ndarray = np.sqrt((np.where(known, a, 0.0) ** 2).sum(axis=0) / count)
    return found


def _trajectories(seed: int, run: ev.FreeRun, study: Study, episodes: Sequence[Episode]) -> dict[str, np.ndarray]:
    """Measured and predicted course of free runs, at most `MOST_RUNS` of them, spread evenly over the test data.

    An angle's prediction is written on the turn of the measured one.
    """
    count, length, ds = run.error.shape
    kept = np.unique(np.linspace(0, count - 1, min(count, MOST_RUNS)).astype(int))
    rows = run.row[kept, None] + np.arange(length)
    where = _places(study, episodes, np.repeat(run.episode[kept], length), rows.ravel())
    states, n = study.system.encoding.states, len(kept) * length
    return {
        "seed": np.full(n * ds, seed),
        "episode": np.repeat(where.episode, ds),
        "segment": np.repeat(where.segment, ds),
        "start": np.repeat(where.time.reshape(-1, length)[:, 0], length * ds),
        "time": np.repeat(where.time, ds),
        "output": np.tile([q.name for q in states], n),
        "unit": np.tile([q.unit for q in states], n),
        "measured": np.where(run.known, run.measured, np.nan)[kept].ravel(),
        "mean": (run.measured + run.error)[kept].ravel(),
        "std": run.std[kept].ravel(),
    }
