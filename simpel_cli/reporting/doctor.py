"""`simpel doctor`: the parts of this installation, and a numerical self-test of a few seconds."""

import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from simpel_cli.config.folders import conf_dir, recordings_dir
from simpel_cli.config.resolved import load
from simpel_cli.errors import SimpelError
from simpel_cli.runs.console import Terminal, aligned
from simpel_cli.runs.manifest import versions
from simpel_cli.runs.settings import Settings, cache_directory, configure

MARKS = {"ok": "ok", "look": "warning", "wrong": "WRONG"}
LEAST_DISK = 2e9  # bytes
LEAST_MEMORY = 3e9


class Finding(NamedTuple):
    """One line of the table.

    Args:
        what: was tested.
        state: ok, look (works, with a warning), or wrong (do not trust results).
        detail: what was found, and what to do.
    """

    what: str
    state: str
    detail: str


def doctor() -> None:
    """Test the installation.

    Raises:
        SimpelError: something is wrong.
    """
    terminal = Terminal(quiet=False)
    began = perf_counter()
    found = [*_surroundings(), *(_tested(what, test) for what, test in TESTS.items())]
    terminal.line(aligned((), [(f.what, MARKS[f.state], f.detail) for f in found]))
    terminal.line()
    wrong = [f.what for f in found if f.state == "wrong"]
    if wrong:
        raise SimpelError(f"{', '.join(wrong)}: this installation computes or stores wrong results; see above.")
    terminal.line(f"nothing is wrong ({perf_counter() - began:.1f} s)")


def _surroundings() -> Iterator[Finding]:
    yield Finding("python", "ok", f"{platform.python_version()} on {platform.platform()}")
    for name, version in versions().items():
        yield Finding(name, "ok" if version else "wrong", version or "missing: install simpel again, `make install`")
    yield _device()
    yield _threads()
    yield _cache()
    yield _room(
        "disk here", float(shutil.disk_usage(Path.cwd()).free), LEAST_DISK, "choose another disk: hydra.run.dir=DIR"
    )
    yield _memory()
    yield _recordings()
    for name, what in (("cc", "simpel export: C code"), ("chromium", "tests of reports")):
        there = shutil.which(name)
        yield Finding(name, "ok", there or f"not installed; needed for {what} only")


def _device() -> Finding:
    import jax

    device = configure(Settings())
    detail = (
        f"{device.device_kind or device.platform} ({jax.default_backend()}), number of devices: {len(jax.devices())}"
    )
    if device.platform == "cpu" and shutil.which("nvidia-smi"):
        return Finding("device", "look", f"{detail}; there is a GPU that JAX does not use: install jax[cuda13]")
    return Finding("device", "ok", detail)


def _threads() -> Finding:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    flags = os.environ.get("XLA_FLAGS", "")
    return Finding("cores", "ok", f"{cores}{f'; XLA_FLAGS={flags}' if flags else ''}")


def _cache() -> Finding:
    try:
        folder = cache_directory()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder):
            pass
    except (OSError, SimpelError) as error:
        return Finding(
            "cache", "look", f"not writable ({error}): every run compiles its programs again; set XDG_CACHE_HOME"
        )
    files = [path for path in folder.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files) / 1e6
    return Finding("cache", "ok", f"{folder}: {len(files)} files, {size:.0f} MB; it may be deleted at any time")


def _memory() -> Finding:
    try:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return Finding("memory", "look", "not reported by this system")
    return _room("memory free", float(free), LEAST_MEMORY, "a fit takes about 1 GB, a policy 1.5 GB")


def _room(what: str, free: float, least: float, cure: str) -> Finding:
    state = "ok" if free >= least else "look"
    return Finding(what, state, f"{free / 1e9:.1f} GB" + ("" if free >= least else f"; {cure}"))


def _recordings() -> Finding:
    folder = recordings_dir()
    there = str(folder) if folder.is_dir() else "not set; only experiments with recorded data need it"
    return Finding("SIMPEL_SHARED", "ok", there)


def _tested(what: str, test: Callable[[], tuple[bool, str]]) -> Finding:
    began = perf_counter()
    try:
        good, detail = test()
    except Exception as error:  # whatever fails here is what the doctor is asked for
        good, detail = False, f"{type(error).__name__}: {str(error).splitlines()[0]}"
    return Finding(what, "ok" if good else "wrong", f"{detail} ({perf_counter() - began:.1f} s)")


def _simulator() -> tuple[bool, str]:
    """Compare a transition in JAX with CasADi's own integration of the same equations."""
    import casadi
    import jax
    import jax.numpy as jnp

    from simpel_cli.config.build import build
    from simpel_cli.dynamics.transition import encoding_of, transition

    model = build(load(conf_dir() / "sim" / "pendulum.yaml"), "sim").model()
    encoding = encoding_of(model)
    step = transition(model, encoding).step
    s, u, p = np.array([0.3, -1.0]), np.array([0.7]), np.array([1.1, 0.9, 1.0])
    found = np.asarray(jax.jit(step)(jnp.asarray(encoding.to_x(s, u)), jnp.asarray(p)))
    x = casadi.SX.sym("x", 2)
    ode = {"x": x, "ode": model.flow().rhs(x, u, p)}
    exact = casadi.integrator("exact", "cvodes", ode, 0, model.dt, {"reltol": 1e-11, "abstol": 1e-12})(x0=s)["xf"]
    target = encoding.to_y(s, np.asarray(exact).ravel(), np.zeros(0))
    error = float(np.abs(target - found).max())
    return error < 1e-4, f"a transition in JAX agrees with CasADi's integrator, difference {error:.0e}"


def _linear_algebra() -> tuple[bool, str]:
    """Solve a system whose answer is known, in a loop that XLA fuses: where jaxlib was wrong before (jax-ml/jax#39103)."""
    import jax
    import jax.numpy as jnp

    random = np.random.default_rng(0)
    root = random.normal(size=(6, 60, 60))
    matrix = jnp.asarray(root @ root.swapaxes(1, 2) / 60 + np.eye(60))
    answer = jnp.asarray(random.normal(size=(6, 60)))
    right = jnp.einsum("bij,bj->bi", matrix, answer)
    solve = jax.jit(jax.vmap(lambda a, b: jax.scipy.sparse.linalg.cg(lambda v: a @ v, b, maxiter=200, tol=1e-12)[0]))
    factor = jax.jit(
        lambda a, b: jnp.linalg.solve(jnp.linalg.cholesky(a).mT, jnp.linalg.solve(jnp.linalg.cholesky(a), b))
    )
    errors = [
        float(jnp.abs(found - answer).max())
        for found in (solve(matrix, right), factor(matrix, right[..., None])[..., 0])
    ]
    return max(errors) < 1e-6, f"conjugate gradients and Cholesky: error {max(errors):.0e}"


def _gradient() -> tuple[bool, str]:
    """Compare a gradient through a scan in single precision with the analytic one."""
    import jax
    import jax.numpy as jnp

    def decayed(rate: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda c, _: (c * jnp.exp(-rate), None), jnp.ones((), rate.dtype), None, length=50)[0]

    found = float(jax.jit(jax.grad(decayed))(jnp.float32(0.02)))
    error = float(abs(found / (-50 * np.exp(-1.0)) - 1))
    return error < 1e-4, f"a gradient through 50 steps in single precision: relative error {error:.0e}"


def _files() -> tuple[bool, str]:
    """Write a checkpoint and metrics, and read them back."""
    from simpel_cli.runs.arrays import load_checkpoint, save_checkpoint
    from simpel_cli.runs.metrics import read_metrics, write_metrics

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        array = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
        save_checkpoint(folder, {"a": array}, {"step": 3})
        leaves, facts = load_checkpoint(folder)
        write_metrics(folder / "metrics.parquet", [{"metric": "nll", "value": 0.1}], {"seed": 1})
        (row,) = read_metrics(folder / "metrics.parquet")
    same = bool(np.array_equal(leaves["a"], array)) and facts == {"step": 3} and (row["value"], row["seed"]) == (0.1, 1)
    return same, "checkpoint and metrics are read back unchanged" if same else "a written file was read back changed"


TESTS: dict[str, Callable[[], tuple[bool, str]]] = {
    "simulators": _simulator, "linear algebra": _linear_algebra, "gradients": _gradient, "files": _files,
}  # fmt: skip
