"""Programs that a later process need not trace again.

JAX's compilation cache keeps what XLA makes of a program; to ask it, a process still traces and lowers the program, which takes
seconds where a model carries dozens of effects. Here the lowered program is kept beside it, by what it is made of: the caller's
name for that, shapes and types of the arguments, every source file of simpel, the versions of JAX and jaxlib, and the device.
Constants of a module that a test replaces are no part of that: such a test switches JAX's cache off.
"""

import contextlib
import ctypes
import gc
import hashlib
import os
import threading
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export

import simpel_cli
from simpel_cli.runs.resident import Resident, resident_mib
from simpel_cli.runs.settings import current_device

SUFFIX = ".program"
# of large programs of small loops: on a CPU as fast as with what XLA does else, and compiled in about half the time
QUICK = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
_KNOWING = threading.Lock()
_IN_MEMORY = Resident()
MOST_KEPT = 200  # files; those that were not used for longest go first


class Program:
    """A jitted function whose lowered form outlives the process where JAX has a compilation cache.

    Args:
        function: of arrays and trees of them.
        name: what it is made of: functions of one name are the same. None: it is not kept.
        trees: named tuples among arguments and results.
    """

    def __init__(self, function: Callable[..., Any], name: str | None, trees: tuple[type, ...] = ()) -> None:
        self._function, self._name, self._trees = function, name, trees
        self._by_shape: dict[Any, Callable[..., Any]] = {}
        self._lock = threading.Lock()

    def __call__(self, *arguments: Any) -> Any:
        """Call it; the first call with arguments of a shape traces it, or finds what an earlier process left."""
        leaves, tree = jax.tree.flatten(arguments)
        kinds = tuple(
            (*np.shape(a), str(jax.dtypes.result_type(a)), bool(getattr(a, "weak_type", False))) for a in leaves
        )
        shape = (tree, kinds, _setting())
        if (found := self._by_shape.get(shape)) is None:
            with self._lock:  # threads of a batch need one program, once
                if (found := self._by_shape.get(shape)) is None:
                    return self._made(arguments, shape)
        _IN_MEMORY.used((id(self), shape))
        return found(*arguments)

    def _made(self, arguments: Any, shape: Any) -> Any:
        """Make the program for arguments of a shape, and return what it comes to."""
        # without a cache it would be compiled once more; of a device's programs the process does not tell the size
        measured = _folder() is not None and current_device().platform == "cpu"
        if measured:
            _returned()
        before = resident_mib()
        found = self._found(arguments, shape)
        result = found(*arguments)
        self._by_shape[shape] = found
        _returned()
        if measured and _IN_MEMORY.add((id(self), shape), resident_mib() - before, self._forget):
            _returned()
        return result

    def _forget(self, name: Any) -> None:
        """Let go of what was compiled for arguments of a shape; a thread that is in it stays in it."""
        self._by_shape.pop(name[1], None)

    def _found(self, arguments: Any, shape: Any) -> Callable[..., Any]:
        folder = _folder()
        if folder is None or self._name is None:
            return _compiled(self._function)
        with _KNOWING:
            for tree in self._trees:
                _known(tree)
        made_of = (self._name, str(shape), SOURCES)
        file = folder / (hashlib.sha256(repr(made_of).encode()).hexdigest()[:40] + SUFFIX)
        with contextlib.suppress(Exception):  # absent, cut off, or of a format that this version cannot read: made anew
            kept = _compiled(export.deserialize(bytearray(file.read_bytes())).call)
            with contextlib.suppress(OSError):  # a folder that may only be read
                os.utime(file)
            return kept
        # left to itself, export takes the machine's first device, also where computations run on another
        platforms = ["cpu"] if current_device().platform == "cpu" else None
        try:
            exported = export.export(jax.jit(self._function), platforms=platforms)(*arguments)
            data = exported.serialize()
        # an operation whose written form JAX does not promise to read again: this process traces it, as every later one will
        except (ValueError, NotImplementedError):
            return _compiled(self._function)
        if _sources() == SOURCES:  # else they were edited since this process read them
            with contextlib.suppress(OSError):  # no room, or a folder that may only be read
                _write(file, data)
        return _compiled(exported.call)


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return jax.jit(function, compiler_options=_options() or None)


def _options() -> dict[str, Any]:
    """Return how programs are compiled: quickly on a CPU, but for what the user's own flags say."""
    flags = os.environ.get("XLA_FLAGS", "")
    if current_device().platform != "cpu" or (flags and not flags.startswith("-")):  # a file of flags
        return {}
    return {name: value for name, value in QUICK.items() if name not in flags and _known_to_xla(name)}


@cache
def _known_to_xla(option: str) -> bool:
    """Whether this version has an option: one of another need not."""
    try:
        jax.jit(lambda x: x + 1, compiler_options={option: QUICK[option]}).lower(0.0).compile()
    except RuntimeError:  # XLA: no such compile option
        return False
    return True


def _returned() -> None:
    """Return to the machine what making a program took and has freed, which the C library else keeps: hundreds of MB."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL("libc.so.6").malloc_trim(0)


@cache
def _known(tree: type) -> None:
    """Tell JAX how a named tuple is written; once."""
    export.register_namedtuple_serialization(tree, serialized_name=f"{tree.__module__}.{tree.__name__}")


def _sources() -> str:
    """Return a digest of all that a program may be traced from."""
    digest = hashlib.sha256()
    root = Path(simpel_cli.__file__).parent
    for folder in (root, root.parent / "simulators"):
        for file in sorted(folder.rglob("*.py")):
            digest.update(str(file.relative_to(root.parent)).encode() + file.read_bytes())
    return digest.hexdigest()


SOURCES = _sources()  # when this process was started, as near as can be


@cache
def _versions() -> tuple[str, ...]:
    return tuple(version(name) for name in ("jax", "jaxlib", "casadi"))  # casadi: which expressions a model comes to


def _setting() -> tuple[str, ...]:
    config: Any = jax.config
    platform = current_device().platform
    return (*_versions(), platform, str(config.jax_enable_x64), str(config.jax_default_matmul_precision))


def _folder() -> Path | None:
    """Return where programs are kept: beside JAX's compilation cache; None: that is off."""
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    return Path(folder).parent / "programs" if folder else None


def _write(file: Path, data: bytes | bytearray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(f".{os.getpid()}.{threading.get_ident()}")
    try:
        part.write_bytes(data)
        part.replace(file)
    except BaseException:  # an interruption, too, leaves no part behind
        part.unlink(missing_ok=True)
        raise
    kept = sorted(file.parent.glob(f"*{SUFFIX}"), key=lambda f: f.stat().st_mtime, reverse=True)
    for old in kept[MOST_KEPT:]:
        old.unlink(missing_ok=True)
