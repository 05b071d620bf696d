"""Places that will not do: a full disk, a directory that cannot be written to, one that another run uses, little memory."""

import contextlib
import os
import resource
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from tests.torture.tally import SMALL, Row, command, finish, fit_in, run

DISKS = (64, 256, 512, 1024, 2048)  # KiB
MEMORY = (0.6, 1.0, 1.5, 2.0)  # GB of address space beyond what Python itself takes


def campaign(out: Path) -> list[Row]:
    """Try every place; what needs rights that one lacks is left out, and said."""
    return [full_disk(out), read_only(out), two_at_once(out), memory(out), clocks(out)]


def full_disk(out: Path) -> Row:
    """Fit on small file systems; what was there before stays as it was."""
    row = Row("full disk")
    for size in DISKS:
        with mounted(out / "disk", f"size={size}k") as folder:
            if folder is None:
                row.notes.append("no right to mount a tmpfs: not tried")
                return row
            row.tries += 1
            (folder / "mine.txt").write_text("mine")
            code, _, err = run(out, ("fit", *SMALL, f"hydra.run.dir={folder / 'run'}"))
            row.look(err, f"{size} KiB")
            row.hit += code != 0
            if (folder / "mine.txt").read_text() != "mine":
                row.lose(f"{size} KiB: a file of the user's")
            if code not in (0, 1, 2):
                row.lose(f"{size} KiB: exit code {code}")
    return row


def read_only(out: Path) -> Row:
    """Fit, report and export into a directory that is mounted read-only."""
    row = Row("read-only directory")
    with mounted(out / "disk", "ro") as folder:
        if folder is None:
            row.notes.append("no right to mount a tmpfs: not tried")
            return row
        fitted = fit_in(out)
        for words in (
            ("fit", *SMALL, f"hydra.run.dir={folder / 'run'}"),
            ("report", fitted, "--out", folder / "report"),
            ("export", fitted, "--out", folder / "export"),
            ("simulate", "sim=pendulum_world", f"out={folder / 'made'}"),
        ):
            row.tries += 1
            code, _, err = run(out, words)
            row.look(err, str(words[0]))
            row.hit += code == 2
            if code != 2:
                row.lose(f"{words[0]}: exit code {code}: {err.strip()[-200:]}")
    return row


def two_at_once(out: Path) -> Row:
    """Start two sweeps in one directory, and two resumes of one run: one works, the other is refused."""
    row = Row("two in one directory")
    for i in range(3):
        folder = out / f"two-{i}"
        shutil.rmtree(folder, ignore_errors=True)
        words = ("sweep", *SMALL, "run.seed=0", f"hydra.sweep.dir={folder}", "hydra.launcher.workers=1")
        row.tries += 1
        with command(out, words) as first:
            time.sleep(0.3 * i)
            with command(out, words) as second:
                ends = [finish(first), finish(second)]
        for _, _, err in ends:
            row.look(err, "sweep")
        codes = sorted(code for code, *_ in ends)
        row.hit += codes == [0, 2]
        if codes != [0, 2]:
            row.lose(f"exit codes {codes}: {[err.strip()[-200:] for *_, err in ends]}")
        shutil.rmtree(folder, ignore_errors=True)
    return row


def memory(out: Path) -> Row:
    """Fit with little memory: a message or a result, and what was there before can be gone on with."""
    row = Row("memory limit")
    for size in MEMORY:
        row.tries += 1
        folder = out / f"memory-{size}"
        shutil.rmtree(folder, ignore_errors=True)
        limit = int((size + 1.0) * 1e9)
        code, _, err = run(
            out, ("fit", *SMALL, f"hydra.run.dir={folder}"),
            preexec_fn=lambda limit=limit: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        )  # fmt: skip
        row.look(err, f"{size} GB")
        row.hit += code != 0
        if code == 0:
            continue
        if (folder / "manifest.json").exists():
            code, _, err = run(out, ("fit", "--resume", folder))
            row.resumed += 1
            row.exact += code == 0
            if code != 0:
                row.lose(f"{size} GB: cannot be gone on with: {err.strip()[-200:]}")
    return row


def clocks(out: Path) -> Row:
    """Fit while the clock jumps by days (needs libfaketime)."""
    row = Row("clock jumps")
    library = next((p for p in Path("/usr/lib").rglob("libfaketime.so.1")), None)
    if library is None:
        row.notes.append("no libfaketime here: not tried")
        return row
    for shift in ("-3650d", "+3650d", "+0 x20", "-2d x0.1"):
        row.tries += 1
        folder = out / "clock"
        shutil.rmtree(folder, ignore_errors=True)
        false = {"LD_PRELOAD": str(library), "FAKETIME": shift, "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
        code, _, err = run(out, ("fit", *SMALL, f"hydra.run.dir={folder}"), env=os.environ | false)
        row.look(err, shift)
        row.hit += 1
        if code != 0:
            row.lose(f"{shift}: exit code {code}: {err.strip()[-200:]}")
    return row


@contextlib.contextmanager
def mounted(folder: Path, options: str) -> Iterator[Path | None]:
    """Give a small file system of its own; None: there is no right to."""
    folder.mkdir(exist_ok=True)
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True)
    try:
        yield folder if done.returncode == 0 else None
    finally:
        if done.returncode == 0:
            subprocess.run(["umount", "-l", str(folder)], check=True)
