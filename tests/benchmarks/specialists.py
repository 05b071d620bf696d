"""What a specialist reaches on the recordings: `python -m tests.benchmarks.specialists` (needs SIMPEL_SHARED).

The structure is given: somebody who knows the rig wrote the equations, effects included. Their parameters, and the first state
of every episode, minimise the simulation error of the training part (scipy's least squares). The test is the protocol of
`simpel discover`: the first state is fitted to the first rows alone, and the errors are those of the rows behind.
"""

import argparse
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy.optimize import least_squares

Rates: TypeAlias = Callable[[Any, Any, Any], Any]  # (x, u, p) -> dx/dt, of arrays whose last axis is the state


class Run(NamedTuple):
    """One episode: times (T,), inputs (T, nu), measured (T, ny)."""

    time: np.ndarray
    u: np.ndarray
    y: np.ndarray


class Rig(NamedTuple):
    """A recording and the equations of somebody who knows it.

    Args:
        rates: (x, u, p) -> rates.
        read: (x, p) -> what the sensors show.
        begin: of p, and beside it the lowest and highest, (n, 3).
        starts: others of p that a fit begins with.
        state: (first row of y) -> guess of the first state.
        runs: episodes to learn from and to test on, by name.
        outputs: names of what is measured.
        scale: and unit of the error.
        first: rows that tell the first state.
        substeps: of Runge and Kutta, a row.
        linear: whether inputs go straight from row to row; else they are held.
        smooth: whether a linear input is a smooth curve through its rows, as a band-limited one is: a cubic in each row, with
            slopes of fourth order at its ends (Hermite).
        per: whether every training episode has parameters of its own, which the test of the same name takes.
        part: rows of the pieces into which a training episode is cut, each with a first state of its own; None: whole.
    """

    rates: Rates
    read: Callable[[Any, Any], Any]
    begin: np.ndarray
    state: Callable[[np.ndarray], np.ndarray]
    train: dict[str, Run]
    test: dict[str, Run]
    outputs: tuple[str, ...]
    scale: tuple[float, str]
    first: int
    substeps: int = 1
    linear: bool = False
    smooth: bool = False
    per: bool = False
    part: int | None = None
    starts: tuple[dict[int, float], ...] = ({},)


def simulated(rig: Rig, p: Any, x: Any, u: Any, step: Any) -> Any:
    """Return what is read along a simulation, (T, ny); step: (T - 1,) seconds."""
    count = rig.substeps

    def row(x: Any, now: tuple[Any, Any, Any, Any]) -> tuple[Any, Any]:
        begin, end, bends, dt = now
        h = dt / count
        for k in range(count):
            shares = [(k + part) / count for part in (0.0, 0.5, 1.0)]
            at = [begin + (end - begin) * s + s * (1 - s) * ((1 - s) * bends[0] - s * bends[1]) for s in shares]
            a = rig.rates(x, at[0], p)
            b = rig.rates(x + h / 2 * a, at[1], p)
            c = rig.rates(x + h / 2 * b, at[1], p)
            d = rig.rates(x + h * c, at[2], p)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        return x, x

    straight, bends = u[1:] - u[:-1], jnp.zeros((len(u) - 1, 2, u.shape[1]))
    if rig.smooth:
        near = jnp.pad(u, ((2, 2), (0, 0)), mode="edge")
        slope = (8 * (near[3:-1] - near[1:-3]) - (near[4:] - near[:-4])) / 12  # a row
        bends = jnp.stack([slope[:-1] - straight, slope[1:] - straight], axis=1)
    rest = jax.lax.scan(row, x, (u[:-1], u[1:] if rig.linear else u[:-1], bends, step))[1]
    return rig.read(jnp.concatenate([x[None], rest]), p)


def _cut(rig: Rig, run: Run) -> list[Run]:
    length = rig.part or len(run.time)
    pieces = [Run(*(a[k : k + length + 1] for a in run)) for k in range(0, len(run.time) - 1, length)]
    whole = [piece for piece in pieces if len(piece.time) == len(pieces[0].time)]
    return whole if rig.part else pieces


def fitted(rig: Rig, runs: list[Run]) -> tuple[np.ndarray, float]:
    """Return the parameters that minimise the simulation error of some episodes, and its mean square."""
    runs = [piece for run in runs for piece in _cut(rig, run)]
    guess = np.array([rig.state(run.y) for run in runs])
    low, high = rig.begin[:, 1], rig.begin[:, 2]
    wide, count = high - low, len(low)
    size = np.maximum(np.abs(guess).max(axis=0), 1e-3)

    def one(v: Any, x: Any, run: tuple[Any, Any, Any]) -> Any:
        time, u, y = run
        return simulated(rig, low + wide * v, x * size, u, jnp.diff(time)) - y

    arrays = [tuple(jnp.asarray(a) for a in run) for run in runs]
    alike = len({a[0].shape for a in arrays}) == 1
    groups = (
        [tuple(jnp.stack(a) for a in zip(*arrays, strict=True))]
        if alike
        else [tuple(a[None] for a in r) for r in arrays]
    )
    errors = jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))
    slopes = jax.jit(jax.vmap(jax.jacfwd(one, argnums=(0, 1)), in_axes=(None, 0, 0)))

    def split(at: np.ndarray) -> list[tuple[Any, Any]]:
        x = at[count:].reshape(guess.shape)
        return [(x, groups[0])] if alike else [(x[k : k + 1], g) for k, g in enumerate(groups)]

    def residual(at: np.ndarray) -> np.ndarray:
        found = [np.asarray(errors(at[:count], x, g)).ravel() for x, g in split(at)]
        return np.nan_to_num(np.concatenate(found), nan=1e3, posinf=1e3, neginf=-1e3)

    def jacobian(at: np.ndarray) -> np.ndarray:
        rows, k = [], 0
        for x, g in split(at):
            by_p, by_x = (np.asarray(a) for a in slopes(at[:count], x, g))
            for p_block, x_block in zip(by_p, by_x, strict=True):
                block = np.zeros((p_block.shape[0] * p_block.shape[1], len(at)))
                block[:, :count] = p_block.reshape(len(block), -1)
                block[:, count + k * guess.shape[1] : count + (k + 1) * guess.shape[1]] = x_block.reshape(
                    len(block), -1
                )
                rows.append(block)
                k += 1
        return np.nan_to_num(np.concatenate(rows))

    best: Any = None
    for start in rig.starts:
        begin = rig.begin[:, 0].copy()
        for row, value in start.items():
            begin[row] = value
        at = np.concatenate([(begin - low) / wide, (guess / size).ravel()])
        free = np.full(guess.size, np.inf)
        bounds = np.concatenate([np.zeros(count), -free]), np.concatenate([np.ones(count), free])
        found = least_squares(residual, np.clip(at, *bounds), jacobian, bounds=bounds, max_nfev=80)
        best = found if best is None or found.cost < best.cost else best
    return low + wide * best.x[:count], 2 * best.cost / len(best.fun)


def tested(rig: Rig, p: np.ndarray, run: Run) -> np.ndarray:
    """Return the errors of a free run, (T - first, ny), whose first state is fitted to the first rows."""
    begin = Run(*(a[: rig.first] for a in run))
    guess = rig.state(run.y)
    size = np.maximum(np.abs(guess), 1e-3)
    steps = jnp.diff(begin.time)
    error = jax.jit(lambda x: (simulated(rig, p, x * size, begin.u, steps) - begin.y).ravel())
    slope = jax.jit(jax.jacfwd(error))
    x = least_squares(lambda x: np.asarray(error(x)), guess / size, lambda x: np.asarray(slope(x))).x * size
    whole = np.asarray(jax.jit(partial(simulated, rig))(p, x, run.u, jnp.diff(run.time)))
    return (whole - run.y)[rig.first :]


def examined(rig: Rig) -> dict[str, np.ndarray]:
    """Return root mean squares of the free run's errors per output, in the rig's unit: of each test episode, and of all."""
    if rig.per:
        p = {name: fitted(rig, [run])[0] for name, run in rig.train.items()}
    else:
        shared = fitted(rig, list(rig.train.values()))[0]
        p = dict.fromkeys(rig.test, shared)
    errors = {name: tested(rig, p[name], run) * rig.scale[0] for name, run in rig.test.items()}
    root = {name: np.sqrt(np.mean(e**2, axis=0)) for name, e in errors.items()}
    return root | {"all": np.sqrt(np.mean(np.concatenate(list(errors.values())) ** 2, axis=0))}


def _table(shared: Path, file: str) -> pd.DataFrame:
    return pd.read_parquet(shared / "data" / file)


def _run(table: pd.DataFrame, inputs: list[str], measured: list[str], time: str = "t") -> Run:
    u = table[inputs].to_numpy(float) if inputs else np.zeros((len(table), 1))
    return Run(table[time].to_numpy(float), u, table[measured].to_numpy(float))


def _smooth_sign(v: Any, width: Any) -> Any:
    return jnp.tanh(v / width)


def cascaded_tanks(shared: Path) -> Rig:
    """Overflow of the upper tank, of which a part reaches the lower one; outflows partly linear; a sensor that ends at 10 V.

    Reference: Rogers, Holmes, Cross and Worden (2017), for the overflow.
    """

    def rates(x: Any, u: Any, p: Any) -> Any:
        k_1, k_2, k_u, spill, edge, share, l_1, l_2 = p
        upper, lower = (jnp.sqrt(jnp.maximum(x[i], 1e-9)) for i in (0, 1))
        out, over = k_1 * upper + l_1 * x[0], spill * jnp.maximum(x[0] - edge, 0.0)
        return jnp.stack([k_u * u[0] - out - over, out + share * over - k_2 * lower - l_2 * x[1]])

    begin = np.array([
        [0.054, 0, 1], [0.09, 0, 1], [0.075, 0, 1], [0.2, 0, 5], [20, 5, 60], [0.3, 0, 1], [1e-3, -0.1, 0.2], [1e-3, -0.1, 0.2],
    ])  # fmt: skip
    train, test = (
        {"": _run(_table(shared, f"cascaded_tanks/{part}.parquet"), ["u"], ["y"])} for part in ("train", "test")
    )
    return Rig(
        rates, lambda x, p: jnp.minimum(x[:, 1:], 10.0), begin, lambda y: np.array([5.0, y[0, 0]]), train, test, ("h_2",),
        (1.0, "V"), 4, substeps=2, starts=tuple({4: edge} for edge in (12.0, 20.0, 30.0)),
    )  # fmt: skip


def silverbox(shared: Path) -> Rig:
    """A stiffening spring, partly quadratic, and an offset (Wigren and Schoukens 2013); the input is band-limited."""

    def rates(x: Any, u: Any, p: Any) -> Any:
        m, d, k, cubic, square, offset = p
        return jnp.stack([x[1], (u[0] + offset - d * x[1] - k * x[0] - square * x[0] ** 2 - cubic * x[0] ** 3) / m])

    begin = np.array([
        [5.1e-6, 4e-6, 6.2e-6], [2.2e-4, 1e-4, 4e-4], [1, 0.8, 1.2], [3, 0, 8], [0, -2, 2], [0, -0.02, 0.02],
    ])  # fmt: skip
    table = _table(shared, "silverbox/measurements.parquet")
    parts = {name: _run(part, ["u"], ["y"]) for name, part in table.groupby("split")}
    train = {"train": parts.pop("train")}
    arrow = parts["test_arrow"]
    parts["test_arrow, its first 32000 rows"] = Run(*(a[:32_000] for a in arrow))
    return Rig(
        rates, lambda x, p: x[:, :1], begin, lambda y: np.array([y[0, 0], (y[1, 0] - y[0, 0]) / 0.0016384]), train, parts,
        ("y",), (1e3, "mV"), 50, substeps=4, linear=True, smooth=True,
    )  # fmt: skip


def emps(shared: Path) -> Rig:
    """Dry friction that differs by direction, viscous friction and an offset of the force (Janot, Gautier and Brunot 2019)."""

    def rates(x: Any, u: Any, p: Any) -> Any:
        mass, viscous, forward, backward, offset, width = p
        sign = _smooth_sign(x[1], width)
        dry = 0.5 * (forward + backward) * sign + 0.5 * (forward - backward) * jnp.abs(sign)
        return jnp.stack([x[1], (u[0] - viscous * x[1] - dry - offset) / mass])

    begin = np.array([
        [95, 85, 105], [200, 100, 450], [20, 0, 60], [20, 0, 60], [-3, -20, 20], [2e-3, 1e-4, 2e-2],
    ])  # fmt: skip
    train, test = ({"": _run(_table(shared, f"emps/{part}.parquet"), ["force"], ["q"])} for part in ("train", "test"))
    return Rig(
        rates, lambda x, p: x[:, :1], begin, lambda y: np.array([y[0, 0], (y[9, 0] - y[0, 0]) / 9e-3]), train, test, ("q",),
        (1e3, "mm"), 20, linear=True, part=500,
    )  # fmt: skip


def tclab(shared: Path) -> Rig:
    """Heat that the heaters exchange, thermometers that lag, and radiation (Hedengren; de Oliveira and Hedengren 2020)."""

    def rates(x: Any, u: Any, p: Any) -> Any:
        air, a_1, a_2, room, between, lag, emissivity = p
        heat, shown = x[:2], x[2:]
        warm = jnp.stack([a_1 * u[0], a_2 * u[1]]) - air * 1e-3 * (heat - room) + between * (heat[::-1] - heat)
        radiated = emissivity * 5.67e-11 * ((heat + 273.15) ** 4 - (room + 273.15) ** 4)
        return jnp.concatenate([(warm - radiated) / 2.0, (heat - shown) / lag])

    begin = np.array([
        [8, 2, 25], [0.01, 0.002, 0.03], [0.0075, 0.002, 0.03], [21, 10, 35], [2e-3, 0, 0.02], [15, 2, 60], [0.3, 0, 1.5],
    ])  # fmt: skip
    table = _table(shared, "tclab/measurements.parquet")
    heaters, seen = ["Q1_pct", "Q2_pct"], ["T1_degC", "T2_degC"]
    train, test = ({part: _run(table[table["split"] == part], heaters, seen)} for part in ("train", "test"))
    return Rig(
        rates, lambda x, p: x[:, 2:], begin, lambda y: np.concatenate([y[0], y[0]]), train, test, ("T_1", "T_2"),
        (1.0, "K"), 6, substeps=4,
    )  # fmt: skip


def ball_drops(shared: Path) -> Rig:
    """A drag of each ball, linear in its speed (de Silva, Higdon, Brunton and Kutz 2020)."""

    def rates(x: Any, u: Any, p: Any) -> Any:
        return jnp.stack([x[1], -9.81 - p[0] * x[1]])

    table = _table(shared, "ball_drops/drops.parquet")
    parts = {split: {} for split in ("train", "test")}  # type: dict[str, dict[str, Run]]
    for (ball, split), part in table.groupby(["ball", "split"]):
        parts[split][ball] = _run(part, [], ["height"])
    return Rig(
        rates, lambda x, p: x[:, :1], np.array([[0.1, -0.5, 3.0]]), lambda y: np.array([y[0, 0], 0.0]), parts["train"],
        parts["test"], ("h",), (1.0, "m"), 6, per=True,
    )  # fmt: skip


def free_pendulum(shared: Path) -> Rig:
    """Dry friction and drag that goes with the square of the speed."""

    def rates(x: Any, u: Any, p: Any) -> Any:
        pull, viscous, dry, drag, width = p
        v = x[1]
        loss = viscous * v + dry * _smooth_sign(v, width) + drag * v * jnp.abs(v)
        return jnp.stack([v, -pull * jnp.sin(x[0]) - loss])

    begin = np.array([[64, 40, 90], [0.01, -0.1, 1], [0.1, 0, 2], [3e-3, 0, 0.1], [0.02, 1e-3, 0.2]])
    table = _table(shared, "single_pendulum_freeswing/freeswing.parquet")
    parts = {split: {} for split in ("train", "test")}  # type: dict[str, dict[str, Run]]
    for (episode, split), part in table.groupby(["episode", "split"]):
        parts[split][episode] = _run(part.iloc[::10], [], ["theta1"])
    return Rig(
        rates, lambda x, p: x[:, :1], begin, lambda y: np.array([y[0, 0], (y[3, 0] - y[0, 0]) / 0.03]), parts["train"],
        parts["test"], ("phi",), (1e3, "mrad"), 26,  # of 10 ms: the first six of 50 ms
    )  # fmt: skip


RIGS = {rig.__name__: rig for rig in (cascaded_tanks, silverbox, emps, tclab, ball_drops, free_pendulum)}


def specialist(name: str, shared: Path) -> dict[str, np.ndarray]:
    """Return what the specialist's model of a recording reaches in free run, in the rig's unit (see `examined`)."""
    with jax.enable_x64(True):
        return examined(RIGS[name](shared))


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.specialists", description=__doc__)
    parser.add_argument("--only", nargs="*", default=list(RIGS), choices=list(RIGS))
    shared = Path(os.environ.get("SIMPEL_SHARED", "../shared"))
    for name in parser.parse_args().only:
        rig = RIGS[name](shared)
        for part, values in specialist(name, shared).items():
            shown = ", ".join(
                f"{output} {value:.4g} {rig.scale[1]}" for output, value in zip(rig.outputs, values, strict=True)
            )
            print(f"{name}, free run, {part or 'test'}: {shown}", flush=True)


if __name__ == "__main__":
    main()
