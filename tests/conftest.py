"""Strict settings for every test: float64 available, no implicit dtype or rank promotion, shapes checked by beartype."""

import inspect
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from command_line import KEPT, ROOT

import simpel_cli  # noqa: F401  sets XLA's flags before JAX opens its backend
from simpel_cli.runs.resident import resident_mib

LONGEST = (
    "sweep", "discover", "online", "methods", "control", "resume", "wrong_inputs", "cli", "pathwise", "fsvgd_posterior",
    "problem", "uninformative_data", "filter", "own_data", "selection", "estimators", "hidden_data", "next_experiment",
    "export", "recorded_systems", "transition", "casadi_jax", "exam",
)  # fmt: skip
LONG = frozenset((Path(__file__).parent / "long.txt").read_text().split())  # whole files, and functions of others
RUNS_A_VERB = {"simpel", "start", "process", "subprocess"}  # names whose use makes a test more than a unit
MOST_BYTES = 2e9  # of one worker, after which it forgets its programs

# tests send Ctrl-C to processes that they start; a shell's background job ignores it, and would hand that on
signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_default_matmul_precision", "highest")  # as `simpel_cli.runs.settings.configure` does
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# compiled programs are shared between tests, workers and runs
jax.config.update("jax_compilation_cache_dir", str(KEPT / "xla"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _runs_a_verb(item: pytest.Function) -> bool:
    """Whether a test, its fixtures, or functions of its file that they call run `simpel` or start a process."""
    fixtures = [each.func for found in item._fixtureinfo.name2fixturedefs.values() for each in found]
    left, seen = [inspect.unwrap(f) for f in (item.function, *fixtures)], set()
    while left:
        function = left.pop()
        if (code := getattr(function, "__code__", None)) is None or code in seen:
            continue
        seen.add(code)
        names = set(code.co_names).union(*(c.co_names for c in code.co_consts if isinstance(c, type(code))))
        if names & RUNS_A_VERB:
            return True
        scope = function.__globals__
        left += [
            scope[n] for n in names if inspect.isfunction(scope.get(n)) and scope[n].__module__ == scope["__name__"]
        ]
    return False


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses by markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by what they need; put the longest files first, so that the workers of `make test` end together."""
    for item in items:
        if isinstance(item, pytest.Function) and not _runs_a_verb(item):
            item.add_marker("unit")
        if "shared" in getattr(item, "fixturenames", ()):
            item.add_marker("needs_recordings")
        if LONG & {(name := item.nodeid.split("[")[0]), name.split("::")[0]}:
            item.add_marker("long")
    rank = {f"test_{name}.py": i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


@pytest.fixture(scope="module", autouse=True)
def _programs() -> Iterator[None]:
    """Compiled programs take gigabytes in the end: let go of them when there are too many."""
    yield
    mib = resident_mib()
    if mib == 0 or mib * 2**20 > MOST_BYTES:
        jax.clear_caches()


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the recordings and the reference's arrays; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("SIMPEL_SHARED", ROOT.parent / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip(f"no recordings at {folder}: set SIMPEL_SHARED")
    return folder
