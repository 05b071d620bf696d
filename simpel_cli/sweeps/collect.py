"""What a sweep has come to: its record, one table of the test metrics of its jobs, the figure."""

import contextlib
import json
from pathlib import Path
from typing import Any, NamedTuple

from simpel_cli.config.overrides import swept_keys
from simpel_cli.errors import ConfigError, SimpelError
from simpel_cli.reporting.figures import draw_sweep
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import typed
from simpel_cli.runs.files import write_text
from simpel_cli.runs.finding import Found, runs_below
from simpel_cli.runs.metrics import read_metrics, write_metrics

RECORD = "sweep.json"
HEADLINES = {  # metric -> what it is called in a line
    "nll": "NLL", "nrmse": "normalised RMSE", "return_in_truth": "return", "return": "return", "success": "success",
}  # fmt: skip


class Record(NamedTuple):
    """What was asked of a sweep: enough to ask it again.

    Args:
        verb: of its jobs.
        words: overrides, as typed.
        config_dir: folder of the user's groups.
        jobs: how many.
    """

    verb: str
    words: list[str]
    config_dir: str | None
    jobs: int


def write_record(root: Path, record: Record) -> None:
    """Write the record of a sweep into its directory."""
    write_text(root / RECORD, json.dumps(record._asdict(), indent=1))


def read_record(root: Path) -> Record:
    """Read the record of a sweep.

    Raises:
        ConfigError: there is none, or it is not readable.
    """
    path = root / RECORD
    try:
        found = json.loads(path.read_text())
        record = Record(**found)
        if not isinstance(record.words, list) or not isinstance(record.jobs, int):
            raise TypeError("not a record of a sweep")
    except FileNotFoundError as error:
        raise ConfigError(
            f"{root}: not the directory of a sweep (it has no {RECORD}). They lie under runs/sweep."
        ) from error
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: not readable ({error}).") from error
    return record


def collect(root: Path, words: list[str], terminal: Terminal) -> list[Found]:
    """Write `sweep.parquet` of the jobs that are done, draw the figure, and name and return the jobs that are not."""
    swept = swept_keys(words)
    found = list(runs_below(root))
    rows: list[dict[str, Any]] = []
    for job in found:
        if job.status == "done":
            own = " ".join(word for word in job.words if word.partition("=")[0] in swept)
            with contextlib.suppress(SimpelError, OSError):
                metrics = read_metrics(job.directory / "metrics.parquet")
                rows += [row | {"run": own or job.directory.name} for row in metrics if row["split"] == "test"]
    left = [job for job in found if job.status != "done"]
    if left:
        shown = ", ".join(str(job.directory.relative_to(root)) for job in left[:10])
        shown += f" and {len(left) - 10} more" if len(left) > 10 else ""
        terminal.line(f"not done: {shown}; `simpel sweep --resume {typed(root)}` runs them")
    if not rows:
        return left
    path = write_metrics(root / "sweep.parquet", rows, {})
    terminal.line()
    terminal.line(str(path), "results")
    figure = draw_sweep(path)
    if figure is not None:
        terminal.line(str(figure), "figure")
    terminal.next([f"simpel report {typed(root)}"])
    return left


def headline(directory: Path) -> str:
    """Return what a finished job came to, in a few words."""
    verdict = directory / "verdict.json"
    if verdict.exists():
        return str(json.loads(verdict.read_text()).get("verdict", ""))
    rows = [r for r in read_metrics(directory / "metrics.parquet") if r["split"] == "test"]
    shown = []
    for metric, name in HEADLINES.items():
        values = [r["value"] for r in rows if r["metric"] == metric and r["output"] in ("joint", "")]
        if values:  # a joint error has no unit, since it may be of several
            shown.append(f"{name} {sum(values) / len(values):.3g}")
    return "  ".join(shown)
