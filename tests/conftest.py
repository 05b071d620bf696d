"""Strict settings for every test: float64 available, no implicit dtype or rank promotion, shapes checked by beartype."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from command_line import KEPT, ROOT

import simpel_cli  # noqa: F401  sets XLA's flags before JAX opens its backend

LONGEST = (
    "wrong_inputs", "cli", "discover", "resume", "filter", "methods", "own_data", "recorded_systems", "estimators",
    "uninformative_data", "sweep", "selection", "fsvgd_posterior", "exam", "next_experiment", "interactions",
    "control", "pathwise",
)  # fmt: skip
MOST_BYTES = 2e9  # of one worker, after which it forgets its programs

# tests send Ctrl-C to processes that they start; a shell's background job ignores it, and would hand that on
signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# compiled programs are shared between tests, workers and runs
jax.config.update("jax_compilation_cache_dir", str(KEPT / "xla"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses by markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that need recordings; put the longest files first, so that the workers of `make test` end together."""
    for item in items:
        if "shared" in getattr(item, "fixturenames", ()):
            item.add_marker("needs_recordings")
    rank = {f"test_{name}.py": i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


@pytest.fixture(scope="module", autouse=True)
def _programs() -> Iterator[None]:
    """Compiled programs take gigabytes in the end: let go of them when there are too many."""
    yield
    pages = Path("/proc/self/statm")
    if not pages.exists() or int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") > MOST_BYTES:
        jax.clear_caches()


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the recordings and the reference's arrays; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("SIMPEL_SHARED", ROOT.parent / "shared"))
    if not (folder / "data").is_dir():
        pytest.skip(f"no recordings at {folder}: set SIMPEL_SHARED")
    return folder
