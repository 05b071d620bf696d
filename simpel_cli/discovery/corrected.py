"""The corrected simulator as YAML that `simpel fit` reads: the declared one, with the effects as terms."""

import re
from typing import Any

from simpel_cli.discovery.selection import Search, Trial
from simpel_cli.discovery.verdict import Z95, interval_of
from simulators.effects import Term
from simulators.effects.term import DELAY, INPUT, LAG, RATE, SENSOR, SENSOR_DELAY


def corrected(sim: dict[str, Any], search: Search, trial: Trial) -> tuple[str, dict[str, Any], list[str]]:
    """Return name, YAML and what could not be written.

    Priors of the effects' parameters are normal, with the 95 % interval of the fit for range; the simulator's own
    keep the ranges that the user declared.

    Args:
        sim: the `sim:` node, as declared.
        search: that was run.
        trial: the chosen effects.
    """
    terms = [search.terms[t] for t in trial.terms]
    name = f"{sim['name']}_with_" + "_and_".join(t.effect for t in terms)
    node = {key: dict(value) if isinstance(value, dict) else value for key, value in sim.items()}
    node["name"] = name
    left_out = []
    taken = {key for section in ("states", "inputs", "parameters", "outputs") for key in sim.get(section) or {}}
    for index, term in zip(trial.terms, terms, strict=True):
        if term.kind in (SENSOR, SENSOR_DELAY):
            left_out.append(term.label)
            continue
        names: dict[str, str] = {}
        for knob, row in zip(term.knobs, search.rows[index], strict=True):
            short = knob.label if knob.label not in taken else f"{knob.label}_{term.acts_on}"
            short = short if short not in taken else knob.name
            taken.add(short)
            names[knob.name] = short
            span = interval_of(search, trial, row, Z95)
            low, high = sorted((span["low"], span["high"]))
            node["parameters"][short] = (
                {"unit": knob.unit, "range": [low, high], "prior": "normal"} if low < high else span["value"]
            )
        _write(node, term, names)
    return name, node, left_out


def _write(node: dict[str, Any], term: Term, names: dict[str, str]) -> None:
    text = _renamed(term.expression, names)
    if term.kind == RATE:
        own = node["dynamics"][term.acts_on]
        text = _renamed(text, {"rate": f"({own})"})
        node["dynamics"][term.acts_on] = f"{own} + ({text})"
    elif term.kind in (DELAY, LAG):
        node["inputs"] = node["inputs"] | {
            term.acts_on: node["inputs"][term.acts_on] | {term.kind: names[term.knobs[0].name]}
        }
    elif term.kind == INPUT:
        for row, own in node["dynamics"].items():
            node["dynamics"][row] = _renamed(str(own), {term.acts_on: f"({text})"})


def _renamed(text: str, swap: dict[str, str]) -> str:
    return re.sub(r"(?<![\w.])[A-Za-z_]\w*", lambda m: swap.get(m[0], m[0]), text)
