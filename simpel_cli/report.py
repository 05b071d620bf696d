"""`report.html`: one self-contained, printable file with the tables and figures of a run."""

import base64
from pathlib import Path
from typing import Any

from simpel_cli.records import write_text

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; color: #1b1b1b; }
h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.1rem; margin-top: 2rem }
.lead { color: #444; margin-top: 0 } img { max-width: 100%; height: auto }
.scroll { overflow-x: auto }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem }
th, td { padding: .25rem .9rem .25rem 0; text-align: right; border-bottom: 1px solid #e4e4e4; white-space: nowrap }
th:first-child, td:first-child { text-align: left } td.text { white-space: normal; text-align: left }
code, pre { background: #f4f4f2; padding: .1rem .3rem; border-radius: 3px; font-size: .85rem }
pre { padding: .7rem; overflow-x: auto } .warn { color: #a33 } .interval { color: #777; font-size: .85em }
@media print { body { margin: 0; max-width: none } h2 { break-after: avoid } img, table { break-inside: avoid } }
</style></head><body>
<h1>{{ title }}</h1><p class="lead">{{ lead }}</p>
{% for table in tables %}<h2>{{ table.title }}</h2>
{% if table.note %}<p>{{ table.note }}</p>{% endif %}
<div class="scroll"><table>
{% if table.head %}<thead><tr>{% for head in table.head %}<th>{{ head }}</th>{% endfor %}</tr></thead>{% endif %}<tbody>
{% for row in table.rows %}<tr>{% for cell in row %}<td{% if table.text %} class="text">{{ cell }}{% else %}>
{% set parts = cell.split(" (") %}{{ parts[0] }}{% if parts[1] %}<br><span class="interval">({{ parts[1] }}</span>{% endif %}
{% endif %}</td>{% endfor %}
</tr>{% endfor %}</tbody></table></div>{% endfor %}
{% for figure in figures %}<h2>{{ figure.title }}</h2><p>{{ figure.note }}</p>
<img alt="{{ figure.title }}" src="data:image/png;base64,{{ figure.data }}">{% endfor %}
<h2>Go on</h2><pre>{{ commands }}</pre>
<h2>Configuration</h2><pre>{{ config }}</pre>
</body></html>
"""

FIGURES = {
    "learning_curves": ("Training", "A loss that still falls asks for more steps (method.steps)."),
    "predictions": (
        "Prediction against measurement",
        "The dark band is the model's own uncertainty, the light band (or bar) adds the learned noise: 95 % of points lie "
        "inside it when the model is right about itself.",
    ),
    "calibration": ("Calibration", "Share of test targets inside the central region of a stated probability."),
    "free_run": (
        "Free run",
        "The model runs on its own predictions along the measured inputs. The claimed standard deviation is that "
        "between the particles, plus the noise of one measurement. An error well above it asks for a better simulator.",
    ),
    "free_run_example": (
        "One free run",
        "The one whose error is the median of all free runs of the first seed. The band is two claimed standard deviations "
        "to either side: the model's own uncertainty, grown along the way, and the noise of one measurement.",
    ),
}


def write_report(
    path: Path,
    *,
    title: str,
    lead: str,
    tables: list[dict[str, Any]],
    figures: list[Path],
    commands: list[str],
    config: str,
) -> Path:
    """Write the report.

    Args:
        path: the file.
        title: heading.
        lead: one sentence below it.
        tables: `{title, head, rows, note, text}` each; cells are shown as they are, escaped.
        figures: PNG files, embedded.
        commands: what to type next.
        config: the resolved configuration.
    """
    from jinja2 import Environment

    shown = []
    for figure in figures:
        heading, note = FIGURES.get(figure.stem, (figure.stem.replace("_", " "), ""))
        shown.append({"title": heading, "note": note, "data": base64.b64encode(figure.read_bytes()).decode()})
    page = Environment(autoescape=True, trim_blocks=True).from_string(TEMPLATE)
    text = page.render(
        title=title, lead=lead, tables=tables, figures=shown, commands="\n".join(commands), config=config
    )
    write_text(path, text)
    return path
