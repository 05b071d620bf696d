"""Inputs that were damaged, cut off or made in bad faith: configuration, measurements, checkpoints, manifests.

Whatever comes, the answer is a result or a message with an exit code, never a traceback; and nothing that a file says is run.
"""

import contextlib
import io
import os
import random
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from tests.torture.tally import TRACEBACK, Row, fit_in

CART = """\
_target_: simulators.model.Declared
name: cart
dt: 0.05
states: {s: {unit: m, range: [-0.5, 0.5]}, v: {unit: m/s, range: [-2, 2]}}
inputs: {u: {unit: V, range: [-3, 3]}}
parameters: {m: {unit: kg, range: [0.5, 2.0]}, k: {unit: N/m, range: [5, 50]}, c: 2.0}
dynamics: {s: v, v: (c*u - k*s)/m}
"""
RIG = """\
path: ../run.csv
time: t
episode: run
columns: {s: pos, v: vel, u: volts}
split: {test_fraction: 0.25, by: episode}
"""
HOSTILE = (  # each would leave the file CANARY behind if anything of it were run
    "!!python/object/apply:os.system ['touch CANARY']",
    "{_target_: os.system, command: touch CANARY}",
    "{_target_: subprocess.run, args: [touch, CANARY]}",
    "__import__('os').system('touch CANARY')",
    "open('CANARY', 'w')",
    "(lambda: exec('open(\\\"CANARY\\\", \\\"w\\\")'))()",
    "${oc.env:HOME}",
    "${oc.decode:'!!python/object/apply:os.system [\"touch CANARY\"]'}",
    "().__class__.__bases__[0].__subclasses__()",
    "9**9**9**9", "&a [*a, *a]", "*unknown", "\x00", "1e999", "-.inf", ".nan", "null", "[]", "{}", "'" * 200, "9" * 5000,
)  # fmt: skip


def campaign(out: Path, count: int, seed: int) -> list[Row]:
    """Try mutations of every kind of input.

    Args:
        out: folder of the campaign; `fitted` in it is a fit.
        count: mutations in all.
        seed: of them.
    """
    fitted = fit_in(out)
    random_ = random.Random(seed)
    kinds: list[tuple[str, float, Callable[[Path], tuple[Path, list[str]]]]] = [
        ("a simulator's YAML", 0.25, _sim),
        ("a data YAML", 0.2, _data),
        ("measurements, CSV", 0.2, _csv),
        ("measurements, Parquet", 0.1, _parquet),
        ("a checkpoint", 0.1, lambda folder: _copy(folder, fitted, "checkpoint/state.safetensors", ["export"])),
        ("a manifest", 0.05, lambda folder: _copy(folder, fitted, "manifest.json", ["export"])),
        ("a run's configuration", 0.05, lambda folder: _copy(folder, fitted, "config.yaml", ["evaluate"])),
        ("metrics", 0.05, lambda folder: _copy(folder, fitted, "metrics.parquet", ["report"])),
    ]
    rows = []
    for name, share, make in kinds:
        row = Row(f"mutated: {name}")
        for _ in range(max(1, round(count * share))):
            folder = out / "mutated"
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            path, words = make(folder)
            path.write_bytes(mutated(path.read_bytes(), random_, binary=path.suffix in (".parquet", ".safetensors")))
            row.tries += 1
            code, err = here(folder, words)
            row.hit += code != 0
            row.look(err, f"{words[0]}")
            if code not in (0, 1, 2, 3, 4, 5):
                row.lose(f"exit code {code}")
            if any(folder.rglob("CANARY")) or (folder / "CANARY").exists() or Path("CANARY").exists():
                row.lose("something that a file says was run")
            if TRACEBACK in err:
                kept = out / f"kept-{name.replace(' ', '_')}-{row.tries}"
                shutil.copytree(folder, kept, dirs_exist_ok=True)
                (kept / "traceback.txt").write_text(err)
        rows.append(row)
        print(
            f"{row.name}: {row.tries} tries, {row.hit} refused, {row.tracebacks} tracebacks, {row.losses} losses",
            flush=True,
        )
    return rows


def mutated(content: bytes, random_: random.Random, *, binary: bool) -> bytes:
    """Return content with one to three kinds of damage."""
    for _ in range(random_.randint(1, 3)):
        content = random_.choice(BINARY if binary else TEXT)(content, random_)
    return content


def _cut(content: bytes, random_: random.Random) -> bytes:
    return content[: random_.randint(0, len(content))]


def _flip(content: bytes, random_: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(random_.randint(1, 8)):
        if changed:
            changed[random_.randrange(len(changed))] = random_.randrange(256)
    return bytes(changed)


def _swap(content: bytes, random_: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    random_.shuffle(lines)
    return b"".join(lines)


def _repeat(content: bytes, random_: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    i = random_.randrange(len(lines))
    return b"".join([*lines[: i + 1], *lines[i:]])


def _hostile(content: bytes, random_: random.Random) -> bytes:
    """Put something in place of a value."""
    text = content.decode("utf-8", "replace")
    marks = [i for i, character in enumerate(text) if character in ":,[{"]
    if not marks:
        return content
    at = random_.choice(marks) + 1
    end = min((i for i in (text.find(c, at) for c in ",]}\n") if i >= 0), default=len(text))
    return (text[:at] + " " + random_.choice(HOSTILE) + text[end:]).encode("utf-8", "replace")


def _drop(content: bytes, random_: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    if lines:
        del lines[random_.randrange(len(lines))]
    return b"".join(lines)


TEXT: Sequence[Callable[[bytes, random.Random], bytes]] = (
    _cut,
    _flip,
    _swap,
    _repeat,
    _drop,
    _hostile,
    _hostile,
    _hostile,
)
BINARY: Sequence[Callable[[bytes, random.Random], bytes]] = (_cut, _flip, _flip)


def here(folder: Path, words: Sequence[str]) -> tuple[int, str]:
    """Run simpel in this process, in a folder; returns exit code and what went to standard error."""
    from simpel_cli.main import main

    before, argv = Path.cwd(), sys.argv
    err = io.StringIO()
    os.chdir(folder)
    sys.argv = ["simpel", *words]
    code = 0
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
            try:
                main()
            except SystemExit as stop:
                code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
            except BaseException:
                err.write(traceback.format_exc())
                code = 1
    finally:
        os.chdir(before)
        sys.argv = argv
    return code, err.getvalue()


def _user(folder: Path) -> Path:
    from tests.command_line import csv, swing

    my = folder / "my"
    (my / "sim").mkdir(parents=True)
    (my / "data").mkdir()
    (my / "sim" / "cart.yaml").write_text(CART)
    (my / "data" / "rig.yaml").write_text(RIG)
    (my / "run.csv").write_text(csv(swing()))
    return my


LOOK = [
    "--config-dir",
    "my",
    "sim=cart",
    "data=rig",
    "method=sysid",
    "method.steps=1",
    "method.starts=1",
    "run.figures=false",
    "run.quiet=true",
]


def _sim(folder: Path) -> tuple[Path, list[str]]:
    return _user(folder) / "sim" / "cart.yaml", ["sims", "cart", "--config-dir", "my"]


def _data(folder: Path) -> tuple[Path, list[str]]:
    return _user(folder) / "data" / "rig.yaml", ["fit", *LOOK, "data.n_train=5"]


def _csv(folder: Path) -> tuple[Path, list[str]]:
    return _user(folder) / "run.csv", ["fit", *LOOK, "data.n_train=5"]


def _parquet(folder: Path) -> tuple[Path, list[str]]:
    import pyarrow.csv
    import pyarrow.parquet as pq

    my = _user(folder)
    pq.write_table(pyarrow.csv.read_csv(my / "run.csv"), my / "run.parquet")
    (my / "data" / "rig.yaml").write_text(RIG.replace("run.csv", "run.parquet"))
    return my / "run.parquet", ["fit", *LOOK, "data.n_train=5"]


def _copy(folder: Path, fitted: Path, name: str, words: list[str]) -> tuple[Path, list[str]]:
    shutil.copytree(fitted, folder / "run", ignore=shutil.ignore_patterns("export", "*.png"))
    return folder / "run" / name, [*words, "run"]
