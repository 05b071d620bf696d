"""`report.html`: one self-contained, printable file with the tables and figures of a run."""

import base64
from pathlib import Path
from typing import Any

from simpel_cli.runs.files import write_text

SCREEN, DPI = 96, 130  # pixels per inch of a page, and of the figures

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; color: #1b1b1b; }
h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.1rem; margin-top: 2rem }
.lead { color: #444; margin-top: 0 } .sentence { font-size: 1.15rem; font-weight: 600; margin: .6rem 0 }
.caption { color: #444; margin: .6rem 0 .2rem } ins { background: #cfe6f5; text-decoration: none; font-weight: 600 }
.words th { text-align: left } img { max-width: 100%; height: auto }
.scroll { overflow-x: auto }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem }
th, td { padding: .25rem .9rem .25rem 0; text-align: right; border-bottom: 1px solid #e4e4e4; white-space: nowrap }
th:first-child, td:first-child { text-align: left } td.text { white-space: normal; text-align: left }
code, pre { background: #f4f4f2; padding: .1rem .3rem; border-radius: 3px; font-size: .85rem }
pre { padding: .7rem; white-space: pre-wrap; overflow-wrap: anywhere } summary { cursor: pointer }
.warn { color: #a33 } .interval { color: #777; font-size: .85em }
@media print { body { margin: 0; max-width: none } h2 { break-after: avoid } img, table { break-inside: avoid } }
</style></head><body>
<h1>{{ title }}</h1><p class="{{ "sentence" if opening else "lead" }}">{{ opening or lead }}</p>
{% if opening %}<p class="lead">{{ lead }}</p>{% endif %}
{% for section in sections %}<h2>{{ section.title }}</h2>
{% if section.note %}<p>{{ section.note }}</p>{% endif %}
{% for block in section.equations %}<p class="caption">{{ block.title }}</p><pre>
{% for line in block.lines %}{% for text, new in line %}{% if new %}<ins>{{ text }}</ins>{% else %}{{ text }}{% endif %}
{% endfor %}

{% endfor %}</pre>{% endfor %}
{% if section.rows %}<div class="scroll"><table{% if section.text %} class="words"{% endif %}>
{% if section.head %}<thead><tr>{% for head in section.head %}<th>{{ head }}</th>{% endfor %}</tr></thead>{% endif %}<tbody>
{% for row in section.rows %}<tr>{% for cell in row %}<td{% if section.text %} class="text">{{ cell }}{% else %}>
{% set parts = cell.split(" (", 1) %}{{ parts[0] }}{% if parts[1] %}<br><span class="interval">({{ parts[1] }}</span>{% endif %}
{% endif %}</td>{% endfor %}
</tr>{% endfor %}</tbody></table></div>{% endif %}
{% if section.image %}<img alt="{{ section.title }}" width="{{ section.width }}"
 src="data:image/{{ section.image }}">{% endif %}
{% if section.after %}<p>{{ section.after }}</p>{% endif %}{% endfor %}
<h2>Go on</h2><pre>{{ commands }}</pre>
{% if config %}<h2>Configuration</h2>
<details><summary>Every key, as resolved</summary><pre>{{ config }}</pre></details>{% endif %}
</body></html>
"""

FIGURES = {
    "prior_predictive": (
        "What the simulator expected",
        "Training targets of the first seed among draws of the simulator with its ranges, at the same inputs, in the order of "
        "the draws' medians. The dark band holds 90 % of the draws, the light one all of them. Targets outside no parameters "
        "explain: the gap GP has to, or an effect that the simulator lacks (simpel discover).",
    ),
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
    "residual": (
        "The latent force",
        "What has to act beside the simulator for the measurements to come about, given all of them "
        "(smoothed, never a finite difference). Points are rows; lines are means with their 95 % band. All are "
        "given the same process noise, so that none is pulled to zero. One that lacks nothing leaves zero everywhere.",
    ),
    "effects": (
        "What the effects explain",
        "The latent force with the corrected parameters and the effects switched off, along the arguments of each effect, less "
        "what effects on other arguments do. The black curve is the fit. The last panel has all effects in one: what they say "
        "should act against what is seen; one with a memory has no curve and shows here.",
    ),
    "traces": (
        "Free runs",
        "The test episode whose error is the median of all. After its first rows the simulator sees inputs only.",
    ),
    "evidence": (
        "Evidence of every candidate",
        "What each would add, everything else fitted anew. Amber: does as well in the final model, so that these data cannot "
        "tell it from the accepted one. A named effect has to beat functions without a name. The axis is linear up to 10 nat, "
        "logarithmic beyond; what is clearly excluded ends at its left edge.",
    ),
    "whiteness": (
        "Whether one-step errors are white",
        "On test episodes, each error in units of the standard deviation that the model claims for it. Inside the grey the "
        "errors have no memory. A wrong model can pass where its process noise is large: then it is corrected in every row.",
    ),
    "control/learning_curves": (
        "Learning the policy",
        "What the mean of the policy earns, at looks along its training; a jump at the end is fine-tuning. The run keeps "
        "the best in the model; the truth chooses nothing.",
    ),
    "control/returns": (
        "Returns",
        "What every episode earned in the plant, and what the model had promised beforehand. A promise far above what is kept "
        "is a policy that exploits the model. A surprise (NLL) that falls is a model that learns.",
    ),
    "control/trajectories": ("Courses", "Every state and command of the episodes. An angle runs on beyond a turn."),
    "control/manoeuvre": ("The manoeuvre", "Of the last episode of an online run, else of that of the median return."),
    "errors": (
        "Error by horizon",
        "Root mean square on test episodes with 95 % intervals over episodes. No error can fall below the measurement noise.",
    ),
}


def figure(path: Path, name: str = "") -> dict[str, Any]:
    """Return a section with a figure, embedded.

    Args:
        path: of the PNG or GIF.
        name: chooses heading and note; left out: the file's stem.
    """
    title, note = FIGURES.get(name or path.stem, (path.stem.replace("_", " "), ""))
    content = path.read_bytes()
    # of the file's header, so that all text is one size
    moving = path.suffix == ".gif"
    pixels = int.from_bytes(content[6:8], "little") if moving else int.from_bytes(content[16:20], "big")
    width = pixels if moving else round(pixels * SCREEN / DPI)
    kind = "gif" if moving else "png"
    return {
        "title": title,
        "note": note,
        "image": f"{kind};base64,{base64.b64encode(content).decode()}",
        "width": width,
    }


def write_report(
    path: Path,
    *,
    title: str,
    lead: str,
    sections: list[dict[str, Any]],
    commands: list[str],
    config: str = "",
    opening: str = "",
) -> Path:
    """Write the report.

    Args:
        path: the file.
        title: heading.
        lead: one sentence below it.
        sections: in order, each `{title, note, ...}` with any of: a table `{head, rows, text}`, whose cells are shown as
            they are, escaped; `equations`, `[{title, lines}]` with a line a list of (text, whether it is new); a figure,
            see `figure`; and a paragraph `after`.
        commands: what to type next.
        config: the resolved configuration; empty: there is none.
        opening: a sentence that says it all, in front of the lead.
    """
    from jinja2 import Environment

    page = Environment(autoescape=True, trim_blocks=True).from_string(TEMPLATE)
    text = page.render(
        title=title, lead=lead, opening=opening, sections=sections, commands="\n".join(commands), config=config
    )
    write_text(path, text)
    return path
