"""SIGKILL and Ctrl-C at random moments of every verb; what can be gone on with ends as if nothing had happened."""

import json
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet as pq
from safetensors import safe_open

from tests.torture.tally import NETWORKS, SMALL, Row, command, finish, fit_in, moments, run

CONTROL = (
    "experiment=pendulum_swing_up", "method.steps=500", *NETWORKS, "policy.steps=8000", "policy.environments=8",
    "policy.looks=4", "policy.hidden=[16]", "control.episodes=4", "control.fine_tune=4", "reward.horizon=12",
    "reward.settled=5",
)  # fmt: skip


class Verb(NamedTuple):
    """How a verb is tried.

    Args:
        name: of the verb, and of the row.
        words: of the command; its directory is `DIR`.
        resume: words that go on with DIR; empty: the command is given again, into another directory.
        results: files below DIR that have to be the same in the end.
    """

    name: str
    words: tuple[str, ...]
    resume: tuple[str, ...]
    results: tuple[str, ...]


def verbs(fitted: str) -> list[Verb]:
    """Return every verb; `fitted` is the directory of a fit."""
    return [
        Verb(
            "fit", ("fit", *SMALL, "hydra.run.dir=DIR"), ("fit", "--resume", "DIR"),
            ("checkpoint/state.safetensors", "metrics.parquet"),
        ),
        Verb(
            "rl-offline", ("rl-offline", *CONTROL, "hydra.run.dir=DIR"), ("rl-offline", "--resume", "DIR"),
            ("policy/policy.safetensors", "metrics.parquet", "episodes.parquet"),
        ),
        Verb(
            "rl-online", ("rl-online", *CONTROL, "online.episodes=3", "hydra.run.dir=DIR"), ("rl-online", "--resume", "DIR"),
            ("episodes/000.parquet", "episodes/002.parquet", "policy/policy.safetensors"),
        ),
        Verb(
            "sweep", ("sweep", *SMALL, "run.seed=0,1", "hydra.sweep.dir=DIR", "hydra.launcher.workers=1"),
            ("sweep", "--resume", "DIR"),
            ("sweep.parquet", "0/checkpoint/state.safetensors", "1/checkpoint/state.safetensors"),
        ),
        Verb(
            "discover",
            (
                "discover", "experiment=hidden_pendulum", "effect=[coulomb_friction]", "close=false", "run.quiet=true",
                "hydra.run.dir=DIR",
            ),
            (), ("verdict.json", "candidates.parquet"),
        ),
        Verb("evaluate", ("evaluate", fitted, "hydra.run.dir=DIR"), (), ("metrics.parquet",)),
        Verb("simulate", ("simulate", "sim=pendulum_world", "out=DIR"), (), ("measurements.parquet",)),
        Verb("report", ("report", fitted, "--out", "DIR"), (), ()),
        Verb("export", ("export", fitted, "--out", "DIR"), (), ("posterior.safetensors", "simulator.casadi", "simulator.c")),
    ]  # fmt: skip


def campaign(out: Path, every: int, seed: int, number: int = signal.SIGKILL, names: Sequence[str] = ()) -> list[Row]:
    """Try every verb.

    Args:
        out: folder of the campaign.
        every: kills of `fit`; other verbs have a share of them.
        seed: of the moments.
        number: of the signal.
        names: of verbs; empty: all of them.
    """
    random = moments(seed)
    fitted = fit_in(out)
    shares = {"fit": 1.0, "rl-offline": 0.5, "rl-online": 0.5, "sweep": 0.4, "discover": 0.25}
    rows = []
    for verb in verbs(str(fitted)):
        if names and verb.name not in names:
            continue
        row = Row(f"{signal.Signals(number).name} of {verb.name}")
        reference = out / f"reference-{verb.name}"
        took = _left_alone(verb, out, reference)
        for i in range(max(2, round(every * shares.get(verb.name, 0.15)))):
            try:
                _tried(
                    row, verb, out / f"{verb.name}-{number}-{i}", reference, random.uniform(0.05, 1.0) * took, number
                )
            except Exception as error:  # whatever it is, it is a finding
                row.lose(f"try {i}: {type(error).__name__}: {error}")
        rows.append(row)
        print(
            f"{row.name}: {row.hit} of {row.tries} in time, {row.losses} losses, {row.tracebacks} tracebacks, "
            f"{row.exact} of {row.resumed} exact",
            flush=True,
        )
    return rows


def _left_alone(verb: Verb, out: Path, reference: Path) -> float:
    """Run it once without harm; returns how long it took."""
    took = reference.with_suffix(".seconds")
    if not took.exists():
        shutil.rmtree(reference, ignore_errors=True)
        for _ in range(2):  # the first compiles
            shutil.rmtree(reference, ignore_errors=True)
            began = time.monotonic()
            code, _, err = run(out, _words(verb.words, reference))
            assert code == 0, f"{verb.name}: {err}"
            seconds = time.monotonic() - began
        took.write_text(str(seconds))
    return float(took.read_text())


def _tried(row: Row, verb: Verb, folder: Path, reference: Path, after: float, number: int) -> None:
    row.tries += 1
    shutil.rmtree(folder, ignore_errors=True)
    with command(folder.parent, _words(verb.words, folder), start_new_session=True) as child:
        time.sleep(after)
        child.send_signal(number)
        code, _, err = finish(child)
    row.look(err, f"after {after:.2f} s")
    row.hit += code not in (0, 1)
    if number == signal.SIGINT and code not in (0, 130, -number):  # a shell says 130 of both
        row.lose(f"Ctrl-C after {after:.2f} s: exit code {code}: {err.strip()[-200:]}")
    for problem in half_written(folder):
        row.lose(f"after {after:.2f} s: {problem}")
    begun = (folder / "manifest.json").exists() or (folder / "sweep.json").exists()
    if verb.resume and begun:
        words = _words(verb.resume, folder)
    else:
        shutil.rmtree(folder, ignore_errors=True)
        words = _words(verb.words, folder)
    code, _, err = run(folder.parent, words)
    row.look(err, f"gone on with after {after:.2f} s")
    if code != 0:
        row.lose(f"after {after:.2f} s it cannot be gone on with: {err.strip()[-300:]}")
        return
    row.resumed += 1
    differing = [name for name in verb.results if _content(folder / name) != _content(reference / name)]
    row.exact += not differing
    if differing:
        row.notes.append(f"after {after:.2f} s: {', '.join(differing)} differ")
    shutil.rmtree(folder)


def half_written(folder: Path) -> list[str]:
    """Return files that bear their final name and cannot be read."""
    readers: dict[str, Callable[[Path], Any]] = {
        ".parquet": pq.read_table,
        ".json": lambda p: json.loads(p.read_text()),
        ".safetensors": lambda p: safe_open(p, "np").keys(),
        ".png": lambda p: _ends(p, b"IEND\xaeB`\x82"),
        ".html": lambda p: _ends(p, b"</html>\n"),
    }  # fmt: skip
    found = []
    for path in sorted(folder.rglob("*")) if folder.exists() else ():
        if path.is_file() and path.suffix in readers and not path.name.startswith("."):
            try:
                readers[path.suffix](path)
            except Exception as error:
                found.append(f"{path.relative_to(folder)} is half written ({type(error).__name__})")
    return found


def _ends(path: Path, end: bytes) -> None:
    content = path.read_bytes()
    if not content.rstrip(b"\n").endswith(end.rstrip(b"\n")):
        raise ValueError("no end")


def _content(path: Path) -> Any:
    """Return what a result says, without times and directories."""
    if path.suffix == ".parquet":
        rows = pq.read_table(path).to_pylist()
        return [
            {k: v for k, v in row.items() if k != "run"}
            for row in rows
            if not str(row.get("metric", "")).endswith("seconds")
        ]
    if path.name == "verdict.json":
        return {k: v for k, v in json.loads(path.read_text()).items() if k != "seconds"}
    return path.read_bytes()


def _words(words: Sequence[str], folder: Path) -> list[str]:
    return [word.replace("DIR", str(folder)) for word in words]
