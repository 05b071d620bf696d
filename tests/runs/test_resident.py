"""Programs that were not used for longest are dropped from memory, and read again where they are called again."""

import gc
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from weakref import ref

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


class Holder:
    """What holds programs, and notes which it lets go of."""

    def __init__(self) -> None:
        self.gone: list[Any] = []

    def drop(self, name: Any) -> None:
        self.gone.append(name)


def test_the_ones_not_used_for_longest_go() -> None:
    holder, kept = Holder(), Resident(most=10.0, least=2)
    for name in "abc":
        assert kept.add(name, 3.0, holder.drop) == 0
    kept.used("a")
    kept.used("unknown")
    assert kept.add("d", 3.0, holder.drop) == 1
    assert holder.gone == ["b"]
    assert kept.add("e", 100.0, holder.drop) == 2
    assert holder.gone == ["b", "c", "a"]  # two stay, however large
    assert kept.add("f", -5.0, holder.drop) == 1  # what a process gave back meanwhile is no room
    assert holder.gone[3:] == ["d"]
    assert kept.add("g", 0.0, holder.drop) == 1
    assert holder.gone[4:] == ["e"]


def test_what_nobody_else_holds_takes_no_room() -> None:
    holder, kept, other = Holder(), Resident(most=10.0, least=1), Holder()
    kept.add("a", 8.0, other.drop)
    gone = ref(other)
    del other
    assert gone() is None
    assert kept.add("b", 8.0, holder.drop) == 0


def test_memory_is_told_or_nothing_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    told = resident_mib()
    assert told == 0.0 if not resident.STATM.exists() else told > 10
    for text in ("", "12", "12 words"):
        (tmp_path / "statm").write_text(text)
        monkeypatch.setattr(resident, "STATM", tmp_path / "statm")
        assert resident_mib() == 0.0
    monkeypatch.setattr(resident, "STATM", tmp_path / "absent")
    assert resident_mib() == 0.0


def programs_of(traced: list[str], *names: str) -> list[Program]:
    """Programs that note when they are traced."""

    def named(name: str, factor: float) -> Program:
        def function(x: jax.Array) -> jax.Array:
            traced.append(name)
            return factor * x

        return Program(function, name)

    return [named(name, float(factor)) for factor, name in enumerate(names, 2)]


def executables() -> int:
    """How many compiled programs the process holds."""
    gc.collect()
    client: Any = jax.devices("cpu")[0].client
    return len(client.live_executables())


def test_a_dropped_program_is_made_again_where_there_is_a_cache(folder: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "_IN_MEMORY", Resident(most=0.0, least=1))
    traced: list[str] = []
    first, second = programs_of(traced, "first", "second")
    x = jnp.arange(3.0)
    for _ in range(2):
        np.testing.assert_allclose(first(x), 2 * np.arange(3.0))
        np.testing.assert_allclose(second(x), 3 * np.arange(3.0))
    assert traced == ["first", "second"]  # what is read again is not traced
    assert len(first._by_shape) == (0 if folder else 1)
    assert len(second._by_shape) == 1


@pytest.mark.parametrize("folder", [True], indirect=True)
def test_what_was_used_last_stays_and_what_goes_leaves_the_memory(
    folder: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = iter([0.0, 1.0] * 10)
    monkeypatch.setattr(programs, "resident_mib", lambda: next(sizes))
    monkeypatch.setattr(programs, "_IN_MEMORY", Resident(most=1.5, least=2))
    a, b, c = programs_of([], "a", "b", "c")
    x = jnp.arange(3.0)
    for program in (a, b, a):
        program(x)
    before = executables()
    c(x)
    assert [len(program._by_shape) for program in (a, b, c)] == [1, 0, 1]
    assert executables() == before  # one more, one less


@pytest.mark.parametrize("folder", [True], indirect=True)
def test_a_program_that_is_let_go_of_is_not_held_here(folder: bool) -> None:
    (program,) = programs_of([], "alone")
    program(jnp.arange(3.0))
    gone = ref(program)
    del program
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize("folder", [True], indirect=True)
def test_the_first_call_runs_a_program_once(folder: bool) -> None:
    calls: list[int] = []
    program = Program(lambda x: x, "once")
    program._found = lambda *_: lambda x: calls.append(1) or x  # type: ignore[method-assign, assignment]
    program(jnp.arange(3.0))
    assert calls == [1]
