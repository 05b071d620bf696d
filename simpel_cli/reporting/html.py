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
<h2>Next commands</h2><pre>{{ commands }}</pre>
{% if config %}<h2>Configuration</h2>
<details><summary>Every key, as resolved</summary><pre>{{ config }}</pre></details>{% endif %}
</body></html>
"""

FIGURES = {
    "prior_predictive": (
        "Prior predictive check",
        "Training targets of the first seed and draws of the simulator with its parameter ranges, at the same inputs, sorted "
        "by the median of the draws. Dark band: 90 % of the draws; light band: all draws. No parameters in the ranges explain "
        "targets outside the bands: the gap GP has to, or an effect that the simulator lacks (simpel discover).",
    ),
    "learning_curves": ("Training", "If the training loss still falls at the end, use more steps (method.steps)."),
    "predictions": (
        "Prediction and measurement, test data",
        "Dark band: uncertainty of the model. Light band (or bar): the same with the learned noise. If the model is "
        "calibrated, 95 % of the points lie inside the light band.",
    ),
    "calibration": ("Calibration", "Share of test targets inside the central region of a stated probability."),
    "free_run": (
        "Error ahead, test data",
        "From a measured state on, the model predicts from its own predictions and the measured inputs. The predicted standard "
        "deviation is that between the particles, plus the noise of one measurement. If the error is well above it, the "
        "simulator needs to be improved.",
    ),
    "free_run_example": (
        "Example of a prediction ahead, test data",
        "The prediction with the median error of all those of the first seed. The band is two predicted standard deviations to "
        "either side: the uncertainty of the model, which accumulates with time, and the noise of one measurement.",
    ),
    "residual": (
        "Latent force (model error)",
        "The rate that has to be added to the simulator to explain the measurements, estimated from all of them by smoothing, "
        "without finite differences. Points: rows; lines: means with their 95 % band. All models have the same process noise, "
        "so that none is biased towards zero. For a simulator that lacks nothing the latent force is zero everywhere.",
    ),
    "effects": (
        "Fitted effects and latent force",
        "Latent force of the corrected simulator with the effects switched off, against the arguments of each effect, minus "
        "the contribution of effects with other arguments. Black curve: the fit. Last panel: estimated latent force against "
        "the sum of all effects. An effect with a memory has no curve and appears in the last panel only.",
    ),
    "traces": (
        "Simulation of a test episode",
        "The test episode with the median error. After the first rows the simulator gets the inputs only.",
    ),
    "evidence": (
        "Evidence of every candidate",
        "Gain in log evidence of each candidate, with all other parameters fitted again. Amber: equally good in the final "
        "model, so that these data do not distinguish it from the accepted effect. A known effect must gain more than an "
        "unknown function. The axis is linear up to 10 nat and logarithmic beyond; bars of excluded candidates are cut off.",
    ),
    "whiteness": (
        "Whiteness of the one-step errors, test data",
        "Each error is divided by its predicted standard deviation. Inside the grey area no autocorrelation is detected. A "
        "wrong model can pass this test if its process noise is large, because the filter then corrects it in every row.",
    ),
    "control/learning_curves": (
        "Learning the policy",
        "Return of the policy without exploration, evaluated during training; a jump at the end is due to fine-tuning. The "
        "policy with the highest return in the model is kept; the true simulator is not used for this choice.",
    ),
    "control/returns": (
        "Returns",
        "Return of every episode in the plant, and the return that the model predicted before it. If the prediction is much "
        "higher, the policy exploits errors of the model. A falling NLL shows that the model improves.",
    ),
    "control/trajectories": ("Trajectories", "Every state and command of the episodes. Angles are unwrapped."),
    "control/manoeuvre": (
        "Manoeuvre",
        "Animation of the last episode (rl-online) or of the episode with the median return (rl-offline).",
    ),
    "errors": (
        "Test error by horizon",
        "RMSE on test episodes with 95 % intervals over episodes. The measurement noise is a lower bound of the error.",
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
        opening: the main result in one sentence, in front of the lead.
    """
    from jinja2 import Environment

    page = Environment(autoescape=True, trim_blocks=True).from_string(TEMPLATE)
    text = page.render(
        title=title, lead=lead, opening=opening, sections=sections, commands="\n".join(commands), config=config
    )
    write_text(path, text)
    return path
