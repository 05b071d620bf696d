# /// script
# requires-python = ">=3.11,<3.13"
# dependencies = ["jax-sysid==1.1.0", "pandas", "pyarrow"]
# ///
"""What black-box state-space identification reaches on the recordings: `uv run --no-project tests/benchmarks/state_space.py`.

The tool is jax-sysid, which asks for an older jax than the project's, so the script has dependencies of its own (and needs
SIMPEL_SHARED). Recordings, split, first rows and error are those of `tests.benchmarks.specialists`, without its equations.

    x_{k+1} = A x_k + B u_k [+ f(x_k, u_k)],    y_k = C x_k + D u_k [+ g(x_k, u_k)]

f and g are networks of one hidden layer. Signals have mean 0 and standard deviation 1, and u has a constant beside the inputs.
What is minimised is the simulation error, with a first state for every piece of the training part. A linear model begins with
a subspace estimate or with random matrices, a nonlinear one with a linear one of its order and small random networks. Fits see
the training part without its tail; the free run of the tail chooses among orders, starts, seeds and penalties; the chosen model
is then fitted on to the whole training part; no run chooses by the test. In the table, *tail* is the error there, in standard
deviations of the outputs: of the best, the median and the worst of all that were tried.

With `--exam DIR --sets 100` the same is done with sets of a blind exam that was run (`tests.exam`), without its equations: the
table has the errors of free runs in those of `simpel discover`.

Two recordings have no input: `free_pendulum`, whose model only decays from its first state, and `ball_drops`, where each ball
has a linear model of two states, driven by the constant. The car is left out: `specialists`, whose protocol this is, lacks it.

SETUPS itself was chosen by hand in some trials, by errors of the tail, except for two that a test has changed: three states, or
networks, of a ball ran away there, and the network of EMPS reached 15 and 246 mm with rows of 5 ms in pieces of 1 and of 5 s.

Reference: Bemporad (2025), IEEE Trans. Autom. Control, for the tool; Chiuso (2007), Automatica 43, for the subspace estimate.
"""

import argparse
import contextlib
import io
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax_sysid.models import Model  # type: ignore[import-not-found]  # not in the project's own environment
from scipy.optimize import least_squares
from specialists import RIGS, Rig, Run

jax.config.update("jax_enable_x64", True)

REST = 1e-7  # penalty of the squares of matrices and first states
STEP, STEPS, EVALUATIONS = 3e-3, 500, 1500  # of Adam, of Adam again, and of L-BFGS


class Setup(NamedTuple):
    """How a recording is put before the tool.

    Args:
        orders: to choose from.
        seeds: of a nonlinear model's networks; a linear one has a random start with the first of them.
        penalties: of the networks' squared weights, to choose from.
        hidden: units of each network; 0: linear models only.
        every: rows of the training part that make one; inputs are averaged over them.
        every_test: the same of the test.
        phases: first rows from which training rows are counted, at most `every`.
        piece: rows of the pieces into which a training episode is cut; None: whole.
        skip: of so many pieces the first is fitted.
        tail: share of the training part that chooses; of several episodes it is the last one, unless they are alike.
        note: to the table.
    """

    orders: tuple[int, ...] = (2, 3)
    seeds: tuple[int, ...] = (0, 1, 2)
    penalties: tuple[float, ...] = (1e-7,)
    hidden: int = 8
    every: int = 1
    every_test: int = 1
    phases: int = 1
    piece: int | None = None
    skip: int = 1
    tail: float = 0.2
    note: str = ""


class Fitted(NamedTuple):
    """A model and what is known of its states.

    Args:
        params: A, B, C, D, and of a nonlinear model the networks' weights.
        mean: of the states along the training part, (nx,).
        factor: lower Cholesky factor of their covariance, (nx, nx).
        noise: standard deviation of what an error does not share with the row before, (ny,).
        order: states.
        seed: of its start; None: the subspace estimate.
        penalty: of its networks.
    """

    params: list[Any]
    mean: np.ndarray
    factor: np.ndarray
    noise: np.ndarray
    order: int
    seed: int | None
    penalty: float = 0.0


SETUPS = {
    "cascaded_tanks": Setup((2, 3, 4), (0, 1), (1e-3, 1e-4)),
    "silverbox": Setup(seeds=(0, 1), piece=500, skip=2, note="every second piece of 500 rows"),
    "emps": Setup(every=10, every_test=10, tail=0.3, note="rows of 10 ms, of which two tell the first state"),
    "tclab": Setup((2, 3), (0, 1), (1e-2, 1e-3), every=3, phases=3, note="one run of 600 s, in rows of 3 s"),
    "free_pendulum": Setup(piece=225, note="no input; pieces of 2.25 s"),
    "ball_drops": Setup((2,), hidden=0, tail=0.4, note="no input; a model of each ball, of some 45 rows"),
}


def transition(x: Any, u: Any, params: list[Any]) -> Any:
    """Return the next states, (..., nx), of states and inputs (..., nu)."""
    ahead = x @ params[0].T + u @ params[1].T
    return ahead + _network(x, u, params[4:9]) if len(params) > 4 else ahead


def output(x: Any, u: Any, params: list[Any]) -> Any:
    """Return what is read, (..., ny)."""
    read = x @ params[2].T + u @ params[3].T
    return read + _network(x, u, params[9:]) if len(params) > 4 else read


def _network(x: Any, u: Any, weights: list[Any]) -> Any:
    by_x, by_u, bias, out, offset = weights
    return jnp.tanh(x @ by_x.T + u @ by_u.T + bias) @ out.T + offset


@jax.jit
def simulated(params: list[Any], x: Any, u: Any) -> tuple[Any, Any]:
    """Return outputs (T, ..., ny) and states (T, ..., nx) along a simulation from x, (..., nx), with u, (T, ..., nu)."""
    return jax.lax.scan(lambda x, u: (transition(x, u, params), (output(x, u, params), x)), x, u)[1]


@jax.jit
def _first_errors(params: list[Any], unit: Any, mean: Any, factor: Any, noise: Any, u: Any, y: Any) -> Any:
    error = (simulated(params, mean + factor @ unit, u)[0] - y) / noise
    return jnp.concatenate([error.ravel(), unit])


_first_slopes = jax.jit(jax.jacfwd(_first_errors, argnums=1))


def first_state(model: Fitted, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the likeliest state of the first of some rows (T, nu) and (T, ny), where states are spread as in training."""

    def call(function: Any) -> Any:
        parts = model.mean, model.factor, model.noise, u, y
        return lambda at: np.nan_to_num(np.asarray(function(model.params, at, *parts)), posinf=1e6, neginf=-1e6)

    found = least_squares(call(_first_errors), np.zeros(model.order), call(_first_slopes), max_nfev=50).x
    return model.mean + model.factor @ found


def free_run(model: Fitted, u: np.ndarray, y: np.ndarray, first: int) -> np.ndarray:
    """Return the errors of a free run behind the rows that tell its first state, (T - first, ny); inf where it ran away."""
    x = first_state(model, u[:first], y[:first])
    error = np.asarray(simulated(model.params, x, u)[0]) - y
    return np.nan_to_num(error, nan=np.inf, posinf=np.inf, neginf=np.inf)[first:]


def subspace(u: np.ndarray, y: np.ndarray, order: int) -> list[np.ndarray]:
    """Return A, B, C, D that suit pieces (S, T, ...): a long regression, states that tell most of it, regressions on these."""
    past, width = min(20, u.shape[1] // 5), u.shape[2] + y.shape[2]
    z, rows = np.concatenate([y, u], axis=-1), range(past, u.shape[1])
    before = np.concatenate([z[:, k - past : k].reshape(len(z), -1) for k in rows])  # the oldest row first
    now_u, now_y = (np.concatenate([a[:, k] for k in rows]) for a in (u, y))
    lags = _regressed(now_y, before, now_u)[0]
    reach = np.concatenate([np.pad(lags[:, : (past - i) * width], ((0, 0), (i * width, 0))) for i in range(past)])
    x = np.linalg.svd(reach @ before.T, full_matrices=False)[2][:order].T * np.sqrt(len(before))
    c, d = _regressed(now_y, x, now_u)
    error = now_y - x @ c.T - now_u @ d.T
    count = len(z)  # rows of one time stand together
    a, b, _ = _regressed(x[count:], x[:-count], now_u[:-count], error[:-count])
    return [a / max(1.0, 1.0001 * np.abs(np.linalg.eigvals(a)).max()), b, c, d]


def _regressed(target: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    found = np.linalg.lstsq(np.concatenate(columns, axis=1), target, rcond=1e-9)[0].T
    return np.split(found, np.cumsum([c.shape[1] for c in columns])[:-1], axis=1)


def known(params: list[Any], x: Any, u: np.ndarray, y: np.ndarray, seed: int | None) -> Fitted:
    """Return a model whose states have standard deviation 1 along pieces (S, T, ...) that begin with x, (S, nx)."""
    read, states = (np.asarray(a) for a in simulated(params, jnp.asarray(x), u.swapaxes(0, 1)))
    if not np.isfinite(states).all():
        raise FloatingPointError("a simulation of the training part ran away")
    size = np.maximum(states.std(axis=(0, 1)), 1e-9)
    a, b, c, d, *networks = (np.asarray(p) for p in params)
    for k in (0, 5) if networks else ():
        networks[k] = networks[k] * size
    if networks:
        networks[3], networks[4] = networks[3] / size[:, None], networks[4] / size
    scaled = (states / size).reshape(-1, len(a))
    spread = np.cov(scaled.T).reshape(len(a), -1) + 1e-6 * np.eye(len(a))
    change = np.diff(read - y.swapaxes(0, 1), axis=0)
    noise = np.maximum(np.sqrt(np.mean(change**2, axis=(0, 1)) / 2), 1e-4)
    params = [a * size / size[:, None], b / size[:, None], c * size, d, *networks]
    return Fitted(params, scaled.mean(axis=0), np.linalg.cholesky(spread), noise, len(a), seed)


def improved(model: Fitted, u: np.ndarray, y: np.ndarray) -> Fitted:
    """Return a model fitted on by jax-sysid to pieces (S, T, ...), all of which are simulated at once as one wide system."""
    count, (order, nu) = len(u), (model.order, u.shape[2])
    tool = Model(
        count * order, count * y.shape[2], count * nu,
        state_fcn=lambda x, u, p: transition(x.reshape(count, order), u.reshape(count, nu), p).ravel(),
        output_fcn=lambda x, u, p: output(x.reshape(count, order), u.reshape(count, nu), p).ravel(),
    )  # fmt: skip
    first = max(10, 2 * order)
    begin = np.array([first_state(model, a[:first], b[:first]) for a, b in zip(u, y, strict=True)])
    tool.init(params=model.params, x0=begin.ravel())

    def networks(p: list[Any], x: Any) -> Any:
        return model.penalty * sum(jnp.sum(w**2) for w in p[4:])

    tool.loss(lambda read, seen: jnp.mean((read - seen) ** 2), REST / count, REST, custom_regularization=networks)
    tool.optimization(STEP, STEPS if len(model.params) > 4 else 0, EVALUATIONS, iprint=-1, memory=20)
    wide_u, wide_y = (a.swapaxes(0, 1).reshape(a.shape[1], -1) for a in (u, y))
    with contextlib.redirect_stdout(io.StringIO()):
        tool.fit(wide_y, wide_u)
    found = known(tool.params, tool.x0.reshape(count, order), u, y, model.seed)
    return found._replace(penalty=model.penalty)


def random_linear(order: int, nu: int, ny: int, seed: int) -> list[np.ndarray]:
    """Return A, B, C, D to begin with: slow modes, small random inputs and outputs."""
    make = np.random.default_rng(seed)
    b, c = 0.1 * make.normal(size=(order, nu)), 0.1 * make.normal(size=(ny, order))
    return [0.95 * np.eye(order), b, c, np.zeros((ny, nu))]


def random_networks(order: int, nu: int, ny: int, hidden: int, seed: int) -> list[np.ndarray]:
    """Return the weights of f and g, whose outputs are small to begin with."""
    make, weights = np.random.default_rng(seed), []
    for width in (order, ny):
        weights += [make.normal(size=(hidden, order)), make.normal(size=(hidden, nu)), make.normal(size=hidden)]
        weights += [1e-3 * make.normal(size=(width, hidden)), np.zeros(width)]
    return weights


class Scaled(NamedTuple):
    """Signals with mean 0 and standard deviation 1, of training episodes; a constant stands behind the inputs."""

    u_mean: np.ndarray
    u_size: np.ndarray
    y_mean: np.ndarray
    y_size: np.ndarray

    def of(self, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """Return inputs (T, nu + 1) and outputs (T, ny)."""
        u = (run.u - self.u_mean) / self.u_size
        return np.concatenate([u, np.ones((len(u), 1))], axis=1), (run.y - self.y_mean) / self.y_size


def scaled(runs: list[Run]) -> Scaled:
    """Return means and standard deviations of some episodes; a signal that does not move keeps its size."""
    u, y = (np.concatenate(parts) for parts in zip(*((r.u, r.y) for r in runs), strict=True))
    return Scaled(u.mean(0), np.where(u.std(0) > 0, u.std(0), 1.0), y.mean(0), y.std(0))


def thinned(run: Run, every: int, phase: int = 0) -> Run:
    """Return each `every`-th row from one on, with the inputs' means until the next."""
    count = (len(run.time) - phase) // every
    u = run.u[phase : phase + count * every].reshape(count, every, -1).mean(axis=1)
    return Run(run.time[phase::every][:count], u, run.y[phase::every][:count])


def pieces(runs: list[Run], setup: Setup, scale: Scaled) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and outputs of pieces as long as the shortest episode, or as said, (S, T, ...), without what is over."""
    rows = min([len(run.time) for run in runs] + ([setup.piece] if setup.piece else []))
    begins = [(scale.of(run), k) for run in runs for k in range(0, len(run.time) - rows + 1, rows)][:: setup.skip]
    u, y = (np.stack([signals[i][k : k + rows] for signals, k in begins]) for i in (0, 1))
    return u, y


def held_out(runs: list[Run], setup: Setup) -> tuple[list[Run], list[Run]]:
    """Return the training part without its tail, and the tail."""
    if len(runs) > 1 and setup.phases == 1:
        return runs[:-1], runs[-1:]
    edges = [int((1 - setup.tail) * len(run.time)) for run in runs]
    both = list(zip(runs, edges, strict=True))
    return [Run(*(a[:k] for a in run)) for run, k in both], [Run(*(a[k:] for a in run)) for run, k in both]


class Choice(NamedTuple):
    """The model that is best on the tail, fitted on to the whole training part, and all that were tried, the best first.

    Args:
        model: that is tested.
        tried: errors of the tail, in standard deviations of the outputs, and models.
        seconds: that all took.
    """

    model: Fitted
    tried: list[tuple[float, Fitted]]
    seconds: float


def chosen(runs: list[Run], setup: Setup, first: int) -> tuple[Scaled, list[Choice]]:
    """Return scale, linear and (if asked for) nonlinear model of thinned episodes, whose `first` rows tell a first state."""
    head, tail = held_out(runs, setup)
    scale = scaled(head)
    u, y = pieces(head, setup, scale)
    nu, ny = u.shape[2], y.shape[2]

    def judged(model: Fitted) -> float:
        errors = np.concatenate([free_run(model, *scale.of(run), first) for run in tail])
        with np.errstate(over="ignore"):
            return float(np.sqrt(np.mean(errors**2)))

    def best(starts: list[Fitted]) -> Choice:
        began, tried = time.perf_counter(), []
        for start in starts:
            with contextlib.suppress(FloatingPointError):
                model = improved(start, u, y)
                tried.append((judged(model), model))
        tried.sort(key=lambda pair: pair[0])
        model = tried[0][1]
        with contextlib.suppress(FloatingPointError):
            model = improved(model, *pieces(runs, setup, scale))
        return Choice(model, tried, time.perf_counter() - began)

    def begun(params: list[np.ndarray], seed: int | None) -> Fitted:
        return known(params, np.zeros((len(u), len(params[0]))), u, y, seed)

    seed = setup.seeds[0]
    starts = [begun(subspace(u, y, n), None) for n in setup.orders]
    linear = best(starts + [begun(random_linear(n, nu, ny, seed), seed) for n in setup.orders])
    if not setup.hidden:
        return scale, [linear]
    starts = []
    for n in setup.orders:
        base = next(model for _, model in linear.tried if model.order == n)
        for seed in setup.seeds:
            params = [*base.params, *random_networks(n, nu, ny, setup.hidden, seed)]
            starts += [base._replace(params=params, seed=seed, penalty=penalty) for penalty in setup.penalties]
    return scale, [linear, best(starts)]


def examined(name: str, rig: Rig, setup: Setup) -> list[str]:
    """Return the table's rows of a recording: of each test episode, and of all."""
    first = -(-rig.first // setup.every_test)
    train = {k: [thinned(r, setup.every, p) for p in range(setup.phases)] for k, r in rig.train.items()}
    test = {k: thinned(r, setup.every_test) for k, r in rig.test.items()}
    whole = [run for runs in train.values() for run in runs]
    groups = [(train[k], [k]) for k in test] if rig.per else [(whole, list(test))]
    errors: dict[str, list[np.ndarray]] = {}
    every: list[list[Choice]] = []
    for runs, names in groups:
        scale, choices = chosen(runs, setup, first)
        every.append(choices)
        for k in names:
            errors[k] = [free_run(c.model, *scale.of(test[k]), first) * scale.y_size * rig.scale[0] for c in choices]
    described = [_described(kind, setup) for kind in zip(*every, strict=True)]
    if len(errors) > 1:
        errors["all"] = [np.concatenate(list(e)) for e in zip(*errors.values(), strict=True)]
    lines = []
    for k, of_kinds in errors.items():
        with np.errstate(over="ignore"):
            shown = [", ".join(f"{v:.3g}" for v in np.sqrt(np.mean(e**2, axis=0))) for e in of_kinds]
        words = [*_two(described), setup.note] if k == list(errors)[-1] else ["", "", ""]
        cells = [f"{name}, {k or 'test'}", ", ".join(rig.outputs), rig.scale[1], *_two(shown), *words]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


OF_EXAM = Setup((2, 3), (0,), (1e-3, 1e-4))
OF_CAR = OF_EXAM._replace(orders=(4, 5))
FIRST = 6  # rows of a test episode that tell its first state, as in `simpel discover`


def of_exam(out: Path, index: int) -> dict[str, Any] | None:
    """Return the errors of free runs of a set of an exam, linear and nonlinear, in those of `simpel discover`.

    None: it was not run, has nothing planted, a speed that was derived, or episodes without some of their values.
    """
    folder, path = out / "sets" / str(index), out / "truth" / f"{index}.json"
    verdict = folder / "run" / "verdict.json"
    if not verdict.exists() or not (truth := json.loads(path.read_text()))["effects"]:
        return None
    if (
        truth["condition"] == "derived velocity"
    ):  # a speed that is the difference of positions is no measurement of its own
        return None
    table = pd.read_parquet(folder / "data" / "run.parquet")
    table = table.drop(columns=[n for n in ("unit",) if n in table])
    ours = json.loads(verdict.read_text())["error"]["after"]["free_run"]
    measured = [n for n in truth["measured"] if n in ours]
    inputs = [n for n in table if n not in ("episode", "t", "split", *truth["measured"])]
    if table[[*measured, *inputs]].isna().any(axis=None):
        return None
    runs: dict[str, list[Run]] = {"train": [], "test": []}
    for _, part in table.groupby("episode"):
        runs[part.split.iloc[0]].append(Run(*(part[n].to_numpy(float) for n in ("t", inputs, measured))))
    began = time.perf_counter()
    scale, choices = chosen(runs["train"], OF_CAR if truth["system"] == "car" else OF_EXAM, FIRST)
    row: dict[str, Any] = {"index": index, "system": truth["system"], "condition": truth["condition"]}
    for name, choice in zip(("linear", "nonlinear"), choices, strict=True):
        errors = np.concatenate([free_run(choice.model, *scale.of(run), FIRST) for run in runs["test"]]) * scale.y_size
        with np.errstate(over="ignore"):
            least = np.sqrt(np.mean(errors**2, axis=0)) / np.array([ours[n] for n in measured])
        row[name] = float(np.exp(np.mean(np.log(least))))
    return row | {"seconds": time.perf_counter() - began}


def exam_table(out: Path, sets: int) -> str:
    """Examine sets of an exam, keep what was found beside it, and return the table."""
    rows = []
    for index in range(sets):
        row = of_exam(out, index)
        if row is not None:
            rows.append(row)
            print(
                f"{index} {row['system']} {row['linear']:.3g} {row['nonlinear']:.3g} {row['seconds']:.0f} s", flush=True
            )
    table = pd.DataFrame(rows)
    table.to_parquet(out / "state_space.parquet")
    lines = ["| sets | n | linear | nonlinear | the better one is better than simpel |", "|---|---|---|---|---|"]
    for name, part in [("all", table), *table.groupby("system")]:
        ahead = int((part[["linear", "nonlinear"]].min(axis=1) < 1).sum())
        medians = " | ".join(f"{part[kind].median():.2f}" for kind in ("linear", "nonlinear"))
        lines.append(f"| {name} | {len(part)} | {medians} | {ahead}/{len(part)} |")
    return "\n".join(lines)


def _two(cells: list[str]) -> list[str]:
    return [*cells, "-"][:2]


def _described(kind: Sequence[Choice], setup: Setup) -> str:
    seconds = f"{sum(choice.seconds for choice in kind):.0f} s"
    if len(kind) > 1:
        orders = [choice.model.order for choice in kind]
        return "; ".join([*(f"{n} states: {orders.count(n)} models" for n in sorted(set(orders))), seconds])
    model, tail = kind[0].model, [error for error, _ in kind[0].tried]
    start = "subspace" if model.seed is None else f"seed {model.seed}"
    penalty = f", penalty {model.penalty:g}" if len(setup.penalties) > 1 and model.penalty else ""
    spread = f"tail {tail[0]:.2g}, {np.median(tail):.2g}, {tail[-1]:.2g} of {len(tail)}"
    return f"{model.order} states, {start}{penalty}; {spread}; {seconds}"


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(prog="tests/benchmarks/state_space.py", description=__doc__)
    parser.add_argument("--only", nargs="*", default=list(SETUPS), choices=list(SETUPS))
    parser.add_argument("--exam", type=Path, metavar="DIR", help="sets of an exam that was run, in place of recordings")
    parser.add_argument("--sets", type=int, default=100, help="of the exam, the first so many")
    options = parser.parse_args()
    if options.exam:
        print(exam_table(options.exam, options.sets))
        return
    shared = Path(os.environ.get("SIMPEL_SHARED", "../shared"))
    print("| recording | output | unit | linear | nonlinear | linear: chosen | nonlinear: chosen | note |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for name in options.only:
        print("\n".join(examined(name, RIGS[name](shared), SETUPS[name])), flush=True)


if __name__ == "__main__":
    main()
