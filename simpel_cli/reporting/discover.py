"""The terminal's screen and the report of `discover`."""

from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.config.resolved import dump, load
from simpel_cli.discovery.verdict.undetectable import in_words
from simpel_cli.reporting.discover_sections import HORIZONS, reliable, rows_of, sections_of, untested, words
from simpel_cli.reporting.figures.canvas import with_interval, with_unit
from simpel_cli.reporting.figures.discover_runs import models_of
from simpel_cli.reporting.html import write_report
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import typed
from simpel_cli.runs.files import read_columns
from simulators.quantity import HELD

KINDS = {
    "effect": "An effect was found.",
    "ambiguous": "Something is missing; these data do not determine which of several causes it is.",
    "none": "No missing effect was found.",
    "unexplained": "Something is missing, and no known effect explains it.",
}
MOST_NAMED = 6  # effects that were not found, in the terminal


def publish(terminal: Terminal, found: dict[str, Any], directory: Path, config: dict[str, Any]) -> Path:
    """Print the verdict, draw the figures, write the report, and say where things lie and what to type next.

    With `report: false` no figure is drawn; the path is then that of the verdict.

    Args:
        terminal: to print to.
        found: `verdict.json`, which lies in the directory together with the tables.
        directory: of the run.
        config: the resolved configuration.
    """
    show(terminal, found, directory)
    commands = next_commands(found, directory, config)
    drawn = config.get("report", True)
    path = _reported(found, directory, config, commands) if drawn else directory / "verdict.json"
    terminal.line(str(path), "report" if drawn else "verdict")
    terminal.next(commands)
    return path


def _reported(found: dict[str, Any], directory: Path, config: dict[str, Any], commands: list[str]) -> Path:
    sim, path, noise = config["sim"], found["corrected_sim"], found["process_noise"]
    return write_report(
        directory / "report.html",
        title=f"simpel discover · {sim['name']} · {config.get('choices', {}).get('data', '')}".rstrip(" ·"),
        opening=found["summary"],
        lead=f"{KINDS[found['verdict']]} {found['candidates_tried']} candidates in {found['seconds']:.0f} s; process noise, "
        f"per square root of a second: {noise['before']:.2g} before, {noise['after']:.2g} after.",
        sections=sections_of(found, sim, load(directory / path) if path else None, directory),
        commands=commands,
        config=dump(config),
    )


def show(terminal: Terminal, found: dict[str, Any], directory: Path) -> None:
    """Print the verdict on one screen."""
    terminal.line()
    terminal.line(found["summary"], style="bold")
    if plan := found["next_experiment"]:
        terminal.line(plan["description"], "run next")
    for plan in found.get("determining_experiments", []):
        terminal.line(plan["description"], "determine")
    terminal.line(_table(found, directory))
    good, _ = reliable(found)
    small = " · ".join(
        f"{words(e['name'])} {e['smallest_detectable']:.2g} {e['unit']}".removesuffix(" 1") for e in good[:MOST_NAMED]
    )
    if small:
        more = len(good) - MOST_NAMED
        terminal.line(
            f"Not found; if present, smaller than: {small}" + (f" · {more} more in the report" if more > 0 else "")
        )
    outside = untested(read_columns(directory / "coverage.parquet")) + in_words(found.get("not_tested", []))
    if outside:
        terminal.line(f"Not tested by these data: {', '.join(outside)}")
    terminal.line(f"{found['candidates_tried']} candidates, {found['seconds']:.0f} s", "time")


def _table(found: dict[str, Any], directory: Path) -> str:
    """Errors before and after, for terminals."""
    both = "after" in models_of(found)
    cells = [["", "", "before", *(["after", "reduction (95 %)"] if both else []), "noise floor"]]
    for row in rows_of(read_columns(directory / "errors.parquet")):
        label = HORIZONS[row["horizon"]].format(steps=found["error"]["horizon_steps"])
        line = [label, with_unit(row["output"], row["unit"]), _number(row["before"])]
        if both:
            line += [
                _number(row["after"]),
                with_interval(row["reduction"], row["reduction_low"], row["reduction_high"], "x"),
            ]
        cells.append([*line, _number(row["noise_floor"])])
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "-"


def next_commands(found: dict[str, Any], directory: Path, config: dict[str, Any]) -> list[str]:
    """Return the next commands, as they can be typed in the same directory."""
    chosen = config.get("choices") or {}
    own = f" --config-dir {typed(chosen['config_dir'])}" if chosen.get("config_dir") else ""
    what = (
        f"experiment={chosen['experiment']}"
        if chosen.get("experiment")
        else f"sim={chosen.get('sim', '')} data={chosen.get('data', '')}"
    )
    lines = []
    if found["corrected_sim"]:
        name = Path(found["corrected_sim"]).stem
        past = f" data.stack_actions={found['stack_actions']}" if found.get("stack_actions") else ""
        lines.append(
            f"simpel fit --config-dir {typed(directory / 'conf')} sim={name} data={chosen.get('data', '')}{past}"
        )
    words = {name: said["word"] for name, said in (found.get("between_rows") or {}).items()}
    moving = ",".join(f"{name}:{word}" for name, word in words.items() if word != HELD)
    said = f" 'data.between_rows={{{moving}}}'" if moving else ""
    late = ",".join(f"{name}:{each['value']:.4g}" for name, each in (found.get("latency") or {}).items())
    again = f" 'data.latency={{{late}}}'" if late else ""
    # a fit takes whole rows only, which the estimate seldom is
    fit = f"simpel discover{own} {what}{again}{said}          # the same, with the latency that was found"
    lines.append(fit if late else f"simpel fit{own} {what}{said}          # with the declared simulator")
    if found.get("not_determined") and not (config.get("discovery") or {}).get("determine"):
        lines.append(
            f"simpel discover{own} {what} discovery.determine=true          # which input determines what is left open"
        )
    if found["verdict"] in ("unexplained", "ambiguous"):
        lines.append(f"simpel discover{own} {what} 'effect=[all,my_effect]'          # with an effect of your own")
    return lines
