"""Figures of the search itself: the evidence of every candidate, and the parameters before and after."""

from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.discovery.search.trials import ACCEPT, TIE
from simpel_cli.reporting.figures.canvas import BLACK, COLOURS, distinct, new_figure, with_interval
from simpel_cli.reporting.figures.discover_runs import models_of
from simpel_cli.runs.files import read_columns

LOWEST = -12.0  # nats; candidates below are excluded, and their bars end at the edge
LINEAR = 10.0  # nats up to which the axis is linear; logarithmic beyond
MOST_BARS = 11
OTHER, TIED = "0.72", COLOURS[4]
NAMELESS: dict[str, Any] = {"facecolor": "0.9", "edgecolor": "0.55", "hatch": "////", "linewidth": 0.5}


def draw_evidence(found: dict[str, Any], path: Path) -> Any:
    """Draw, per step, what each candidate would add to the evidence, the accepted one and those it ties with."""
    table = read_columns(path)
    if not table:
        return None
    steps = distinct(table["step"].tolist())
    columns = min(len(steps), 2)
    figure, axes = new_figure(len(steps), 9.4 / columns, 0.9 + 0.235 * MOST_BARS, columns=columns)
    for axis, step in zip(axes, steps, strict=True):
        own = {name: column[table["step"] == step] for name, column in table.items()}
        _bars(axis, own, found, float(own["asked"][0]))
        best = np.flatnonzero(own["accepted"]).tolist()
        # a search that began with several effects at once has a step at which none of the candidates was taken
        none = "no further effect is accepted" if step == steps[-1] else "several effects together are worth more"
        stays = {(e["name"], e["acts_on"]) for e in found["effects"]}
        later = "" if not best or _key(own, best[0]) in stays else " (given up later)"
        what = f"+ {_label(own, best[0])}{later}" if best else none
        axis.set_title(f"step {step}: {what}", fontsize=9, loc="left")
    _legend(figure)
    return figure


def _legend(figure: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(color=COLOURS[0], label="accepted"),
        Patch(color=TIED, label="equally good in the final model"),
        Patch(color=OTHER, label="others"),
        Patch(**NAMELESS, label="unknown function"),
        Line2D(
            [],
            [],
            color=COLOURS[2],
            linestyle="--",
            linewidth=1,
            label=f"required gain: {ACCEPT:g} nat, more in later steps",
        ),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8, frameon=False)


def _label(own: dict[str, np.ndarray], i: int) -> str:
    if own["depends_on"][i]:
        return f"unknown function of {own['depends_on'][i]} on {own['acts_on'][i]}"
    return f"{own['effect'][i]} on {own['acts_on'][i]}".replace("_", " ")


def _bars(axis: Any, own: dict[str, np.ndarray], found: dict[str, Any], least: float) -> None:
    gain = own["log_evidence_gain"]
    finite = [i for i in np.argsort(-np.nan_to_num(gain, nan=-np.inf), kind="stable").tolist() if np.isfinite(gain[i])]
    accepted = [i for i in finite if own["accepted"][i]]
    shown = finite[:MOST_BARS]
    if accepted and accepted[0] not in shown:
        shown = [*shown[:-1], accepted[0]]
    rivals = _rivals(found, own, accepted)
    values = gain[shown]
    high = max(float(values.max(initial=0.0)), 3 * least)
    axis.set_xscale("symlog", linthresh=LINEAR, linscale=0.8)
    axis.set_xlim(LOWEST, 6 * high if high > LINEAR else 1.6 * high)
    ticks = [-10.0, 0.0] + [float(10**n) for n in range(1, 7) if 10**n <= 2 * high]
    axis.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axis.minorticks_off()
    for place, i in enumerate(shown):
        colour = COLOURS[0] if i in accepted else TIED if _key(own, i) in rivals else OTHER
        named = not own["depends_on"][i]
        axis.barh(place, max(gain[i], LOWEST), height=0.72, **({"color": colour} if named else NAMELESS))
        # beside the bar's end; a bar that ends at the edge has its number on the other side of zero
        axis.annotate(
            f"{gain[i]:+.1f}" if abs(gain[i]) < 100 else f"{gain[i]:+.0f}", (max(gain[i], 0), place), xytext=(3, 0),
            textcoords="offset points", va="center", fontsize=7, color=BLACK if i in accepted else "0.3",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
        )  # fmt: skip
    axis.set_yticks(range(len(shown)), [_label(own, i) for i in shown], fontsize=7.5)
    for tick, i in zip(axis.get_yticklabels(), shown, strict=True):
        tick.set_fontweight("bold" if i in accepted else "normal")
    axis.set_ylim(len(shown) - 0.4, -0.6)
    axis.axvline(0, color="0.4", linewidth=0.8)
    axis.axvline(least, color=COLOURS[2], linewidth=1, linestyle="--")
    axis.set_xlabel("gain in log evidence [nat]", fontsize=8)
    axis.grid(visible=False, axis="y")
    _bracket(axis, own, shown, accepted)
    hidden = len(gain) - len(shown)
    if hidden:
        lost = len(gain) - len(finite)
        text = f"{hidden} more below" + (f", {lost} of them diverged" if lost else "")
        axis.text(0.99, 0.02, text, transform=axis.transAxes, ha="right", va="bottom", fontsize=7, color="0.4")


def _key(own: dict[str, np.ndarray], i: int) -> tuple[str, str]:
    return str(own["effect"][i]), str(own["acts_on"][i])


def _rivals(found: dict[str, Any], own: dict[str, np.ndarray], accepted: list[int]) -> set[tuple[str, str]]:
    """Names that do as well as the accepted one in the final model."""
    for effect in found["effects"]:
        if accepted and effect["name"] == own["effect"][accepted[0]]:
            return {(m["name"], m["acts_on"]) for m in effect["class_members"][1:]}
    return set()


def _bracket(axis: Any, own: dict[str, np.ndarray], shown: list[int], accepted: list[int]) -> None:
    """Join the bars of names that lie within a tie of the accepted one."""
    if not accepted:
        return
    best = own["log_evidence_gain"][accepted[0]]
    tied = [p for p, i in enumerate(shown) if abs(own["log_evidence_gain"][i] - best) <= TIE]
    if len(tied) < 2:
        return
    ends = min(tied) - 0.36, max(tied) + 0.36
    at = axis.get_yaxis_transform()
    axis.plot(
        [0.985, 1.0, 1.0, 0.985], [ends[0]] * 2 + [ends[1]] * 2, color=BLACK, linewidth=1, transform=at, clip_on=False
    )
    axis.text(1.012, sum(ends) / 2, f"tie:\nwithin\n{TIE:g} nat", transform=at, va="center", ha="left", fontsize=6.5)


def draw_parameters(found: dict[str, Any], path: Path) -> Any:
    """Draw parameters with 90 % intervals, before and after, in their declared ranges."""
    table = read_columns(path)
    if "after" not in models_of(found):
        table = {name: column[table["model"] == "before"] for name, column in table.items()}
    if not table or not len(table["parameter"]):
        return None
    keys = distinct(zip(table["parameter"], table["effect"], strict=True))
    figure, (axis,) = new_figure(1, 10.0, 0.9 + 0.42 * len(keys))
    labelled: set[str] = set()
    for place, key in enumerate(keys):
        rows = [i for i, k in enumerate(zip(table["parameter"], table["effect"], strict=True)) if k == key]
        low, high = table["range_low"][rows[0]], table["range_high"][rows[0]]
        axis.barh(place, 1, height=0.56, color="0.89", zorder=0)
        texts = []
        for i in rows:
            model = str(table["model"][i])
            colour, shift = (COLOURS[1], -0.13) if model == "before" else (COLOURS[0], 0.13)
            ends = np.array([table[c][i] for c in ("low", "value", "high")])
            a, b, c = np.clip((ends - low) / (high - low), -0.04, 1.04)
            label = {"before": "calibrated simulator", "after": "corrected simulator"}[model]
            axis.plot([a, c], [place + shift] * 2, color=colour, linewidth=2)
            axis.plot(b, place + shift, "o", color=colour, markersize=4.5, label=None if model in labelled else label)
            labelled.add(model)
            texts.append(with_interval(ends[1], ends[0], ends[2]))
        unit = table["unit"][rows[0]]
        axis.text(
            1.17, place, " → ".join(texts) + (f" {unit}" if unit not in ("", "1") else ""), va="center", fontsize=8
        )
        for at, value, side in ((0, low, "right"), (1, high, "left")):
            axis.text(
                at + (-0.008 if at == 0 else 0.008),
                place,
                f"{value:.3g}",
                va="center",
                ha=side,
                fontsize=6.5,
                color="0.5",
            )
    names = [name if not effect else f"{name}  ({effect.replace('_', ' ')})" for name, effect in keys]
    axis.set_yticks(range(len(keys)), names, fontsize=8.5)
    axis.tick_params(axis="y", pad=22, length=0)
    axis.set_xlim(-0.06, 2.15)
    axis.set_ylim(len(keys) - 0.5, -0.5)
    axis.set_xticks([])
    axis.spines[["left", "bottom"]].set_visible(False)
    axis.grid(visible=False)
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=2, fontsize=8, frameon=False)
    return figure
