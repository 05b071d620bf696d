"""Programs that were not used for longest are dropped from memory, and read again where they are called again."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.runs import programs, resident
from simpel_cli.runs.programs import Program
from simpel_cli.runs.resident import Resident, resident_mib


@pytest.fixture(params=[True, False], ids=["cache", "no cache"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[bool]:
    """Whether there is a cache on disk, from which a program that was dropped can be read."""
    config: Any = jax.config
    before = config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "xla") if request.param else None)
    yield request.param
    jax.config.update("jax_compilation_cache_dir", before)


def test_the_ones_not_used_for_longest_go() -> None:
    gone: list[str] = []
    kept = Resident(most=10.0, least=2)
    for name in "abc":
        assert kept.add(name, 3.0, lambda name=name: gone.append(name)) == 0  # type: ignore[misc]
    kept.used("a")
    kept.used("unknown")
    assert kept.add("d", 3.0, lambda: gone.append("d")) == 1
    assert gone == ["b"]
    assert kept.add("e", 100.0, lambda: gone.append("e")) == 2
    assert gone == ["b", "c", "a"]  # two stay, however large
    assert kept.add("f", -5.0, lambda: gone.append("f")) == 1  # what a process gave back meanwhile is no room
    assert gone[3:] == ["d"]
    assert kept.add("g", 0.0, lambda: gone.append("g")) == 1
    assert gone[4:] == ["e"]


def test_memory_is_told_or_nothing_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    told = resident_mib()
    assert told == 0.0 if not resident.STATM.exists() else told > 10
    for text in ("", "12", "12 words"):
        (tmp_path / "statm").write_text(text)
        monkeypatch.setattr(resident, "STATM", tmp_path / "statm")
        assert resident_mib() == 0.0
    monkeypatch.setattr(resident, "STATM", tmp_path / "absent")
    assert resident_mib() == 0.0


def test_a_dropped_program_is_made_again_where_there_is_a_cache(folder: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "_IN_MEMORY", Resident(most=0.0, least=1))
    sizes = iter(range(0, 1000, 50))
    monkeypatch.setattr(programs, "resident_mib", lambda: float(next(sizes)))
    traced: list[str] = []

    def named(name: str, factor: float) -> Program:
        def function(x: jax.Array) -> jax.Array:
            traced.append(name)
            return factor * x

        return Program(function, name)

    first, second = named("first", 2.0), named("second", 3.0)
    x = jnp.arange(3.0)
    for _ in range(2):
        np.testing.assert_allclose(first(x), 2 * np.arange(3.0))
        np.testing.assert_allclose(second(x), 3 * np.arange(3.0))
    assert traced == ["first", "second"]  # what is read again is not traced
    assert len(first._by_shape) == (0 if folder else 1)
    assert len(second._by_shape) == 1
