"""What a person sees in the terminal: labelled lines, one progress bar, plain tables. Quiet when asked."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LOG = logging.getLogger("simpel")


class Terminal:
    """Labelled lines on standard output, kept in `run.log` as well.

    Args:
        quiet: print nothing.
        log: file that gets every line with a time stamp; None: no file.
    """

    def __init__(self, quiet: bool, log: Path | None = None) -> None:
        from rich.console import Console

        # a wide console when the output is a file or a pipe: lines are for grep, not for wrapping
        self.console = Console(quiet=quiet, highlight=False, width=None if sys.stdout.isatty() else 240)
        LOG.setLevel(logging.INFO)
        LOG.propagate = False
        for handler in list(LOG.handlers):
            handler.close()
            LOG.removeHandler(handler)
        handler = logging.FileHandler(log) if log is not None else logging.NullHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
        LOG.addHandler(handler)

    def line(self, text: str = "", label: str = "", style: str = "") -> None:
        """Print a line, with a label in its own column."""
        shown = f"{label:<10}{text}" if label else text
        self.console.print(shown, style=style, markup=False, soft_wrap=True)
        if shown:
            LOG.info(shown)

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
