"""A program's lowered form outlives the process, and only as long as nothing that it is made of changes."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.runs import programs
from simpel_cli.runs.programs import Program


class Pair(NamedTuple):
    """What a program of these tests takes and returns."""

    a: jax.Array
    b: jax.Array


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    config: Any = jax.config
    before = config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "xla"))
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


class Traced:
    """A function that counts how often it is traced."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, pair: Pair, scale: jax.Array) -> Pair:
        self.count += 1
        return Pair(jnp.linalg.solve(pair.a, pair.b), scale * pair.b)


A, B = np.array([[2.0, 1.0], [0.0, 4.0]]), np.array([3.0, 8.0])
PAIR, SCALE = Pair(jnp.asarray(A), jnp.asarray(B)), jnp.asarray(2.0)


def run(function: Traced, name: str | None = "solve") -> Program:
    program = Program(function, name, (Pair,))
    found = program(PAIR, SCALE)
    np.testing.assert_allclose(found.a, np.linalg.solve(A, B))
    np.testing.assert_allclose(found.b, 2 * B)
    return program


def test_a_second_process_does_not_trace(folder: Path) -> None:
    first, second = Traced(), Traced()
    run(first)
    assert first.count == 1
    assert len(list(folder.glob("*.program"))) == 1
    run(second)
    assert second.count == 0


def test_other_shapes_and_names_are_other_programs(folder: Path) -> None:
    run(Traced())
    other = Traced()
    run(other, "another")
    assert other.count == 1
    wider = Traced()
    Program(wider, "solve", (Pair,))(Pair(jnp.eye(3), jnp.ones(3)), SCALE)
    assert wider.count == 1
    assert len(list(folder.glob("*.program"))) == 3


def test_what_was_made_from_other_sources_is_not_used(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(Traced())
    monkeypatch.setattr(programs, "SOURCES", "others")
    monkeypatch.setattr(programs, "_sources", lambda: "others")
    edited = Traced()
    run(edited)
    assert edited.count == 1


def test_a_file_that_was_cut_off_is_made_anew(folder: Path) -> None:
    run(Traced())
    (file,) = folder.glob("*.program")
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    again = Traced()
    run(again)
    assert again.count == 1
    assert len(file.read_bytes()) == len(whole)


def test_the_folder_does_not_grow_for_ever(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "MOST_KEPT", 2)
    for name in "abc":
        run(Traced(), name)
    assert len(list(folder.glob("*.program"))) == 2


def test_without_a_folder_nothing_is_kept(folder: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", None)
    run(Traced())
    assert not folder.exists()
    jax.config.update("jax_compilation_cache_dir", str(folder / "file" / "xla"))
    folder.mkdir()
    (folder / "file").write_text("in the way")
    run(Traced())  # no place to write is no error
    run(Traced(), None)


def test_sources_that_were_edited_since_are_not_written_under_the_name_of_the_new_ones(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs, "_sources", lambda: "edited")
    run(Traced())
    assert not list(folder.glob("*"))


def test_nothing_is_left_of_a_file_that_could_not_be_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, target: Path) -> Path:
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "replace", full)
    run(Traced())
    assert not list(folder.glob("*"))


def test_a_number_without_a_type_of_its_own_is_another_program(folder: Path) -> None:
    program = Program(lambda x, s: x * s, "scaled")
    x = jnp.ones(2, jnp.float32)
    assert program(x, jnp.asarray(2.0)).dtype == jax.jit(lambda x, s: x * s)(x, jnp.asarray(2.0)).dtype


def test_how_programs_are_compiled_is_the_users_to_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "current_device", lambda: SimpleNamespace(platform="cpu"))
    level, emitters = programs.QUICK
    monkeypatch.setenv("XLA_FLAGS", "")
    assert set(programs._options()) == {name for name in (level, emitters) if programs._known_to_xla(name)}
    monkeypatch.setenv("XLA_FLAGS", f"--{level}=2")
    assert level not in programs._options()
    monkeypatch.setenv("XLA_FLAGS", "flags.txt")
    assert programs._options() == {}
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(programs, "current_device", lambda: SimpleNamespace(platform="gpu"))
    assert programs._options() == {}


def test_an_option_that_this_version_of_xla_does_not_have_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "QUICK", {"no_such_option": 1})
    monkeypatch.setattr(programs, "current_device", lambda: SimpleNamespace(platform="cpu"))
    monkeypatch.setenv("XLA_FLAGS", "")
    assert programs._options() == {}
