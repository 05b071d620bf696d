"""What a person sees in the terminal: labelled lines, one progress bar, plain tables. Quiet when asked."""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

_silent = ContextVar("_silent", default=False)


@contextmanager
def silence() -> Iterator[None]:
    """Print nothing meanwhile: of a worker's job its sweep speaks. It is no setting of the run, which may be shown later."""
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)


class _Screen(Console):
    """A console whose reader may go away: `simpel fit | head` ends the printing, not the run."""

    def on_broken_pipe(self) -> None:
        """Print nothing from here on; Rich's own answer is to exit."""
        self.quiet = True
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())  # what Python still holds back is flushed when the process ends
        os.close(nowhere)


class Terminal:
    """Labelled lines on standard output, kept in `run.log` as well.

    A run does not depend on its output being read: where standard output is closed, the lines go to `run.log` alone.

    Args:
        quiet: print nothing.
        log: file that gets every line with a time stamp; None: no file.
    """

    def __init__(self, quiet: bool, log: Path | None = None) -> None:
        # a wide console when the output is a file or a pipe: lines are for grep, not for wrapping
        wide = sys.stdout is None or not sys.stdout.isatty()  # None: closed before the start (`simpel fit >&-`)
        self.console = _Screen(quiet=quiet or _silent.get(), highlight=False, width=240 if wide else None)
        self.log = log

    def line(self, text: str = "", label: str = "", style: str = "") -> None:
        """Print a line, with a label in its own column."""
        shown = f"{label:<10}{text}" if label else text
        self.console.print(
            Text(shown, style=style), soft_wrap=True
        )  # a style of the whole print would be a board's, too
        if shown and self.log is not None:
            now = datetime.now()
            with self.log.open("a") as file:
                file.write(f"{now:%Y-%m-%d %H:%M:%S},{now.microsecond // 1000:03d} {shown}\n")

    def next(self, commands: Sequence[str]) -> None:
        """Print commands to go on with, one a line."""
        for i, command in enumerate(commands):
            self.line(f"{'' if i == 0 else ' ' * 10}{command}", "" if i else "next")

    @contextmanager
    def working(self, now: Callable[[], str]) -> Iterator[None]:
        """Show below the lines what goes on, once a second; nothing where nobody looks."""
        if not self.console.is_terminal or self.console.quiet:
            yield
            return
        from rich.live import Live

        shown = lambda: Text(now(), style="dim")  # noqa: E731
        with Live(console=self.console, get_renderable=shown, refresh_per_second=1, transient=True):
            yield

    @contextmanager
    def progress(self, label: str, total: int, start: int) -> Iterator[Any]:
        """Show a bar with time left; yields `update(step, note)`."""
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn(f"{label:<9}"), BarColumn(24), MofNCompleteColumn(), TimeRemainingColumn(elapsed_when_finished=True),
            TextColumn("{task.fields[note]}"),
        )  # fmt: skip
        with Progress(*columns, console=self.console) as bar:
            task = bar.add_task(label, total=total, completed=start, note="")

            def update(step: int, note: str) -> None:
                bar.update(task, completed=step, note=note)

            yield update


class Board:
    """What runs at the moment, redrawn below the lines; nothing where nobody looks.

    Args:
        terminal: whose lines stay above it.
    """

    def __init__(self, terminal: Terminal) -> None:
        from rich.live import Live

        self._began: dict[str, float] = {}
        self._drawn = 0.0
        self._live: Any = None
        if terminal.console.is_terminal and not terminal.console.quiet:
            self._live = Live(console=terminal.console, auto_refresh=False, transient=True)

    def show(self, running: Callable[[], list[tuple[str, str]]]) -> None:
        """Draw it, at most once a second.

        Args:
            running: gives name and state of everything that runs.
        """
        from rich.table import Table

        now = time.monotonic()
        if self._live is None or now - self._drawn < 1.0:
            return
        self._drawn = now
        found = running()
        self._began = {name: self._began.get(name, now) for name, _ in found}
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for name, state in found:
            table.add_row(Text("running", style="dim"), Text(name), Text(state), f"{now - self._began[name]:.0f} s")
        self._live.update(table, refresh=True)

    def __enter__(self) -> "Board":
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return columns of equal width, for terminals; the head may be empty."""
    cells = [head, *rows] if head else rows
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    return "\n".join(
        "  " + "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in cells
    )
