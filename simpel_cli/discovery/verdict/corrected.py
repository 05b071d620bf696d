"""The corrected simulator as YAML that `simpel fit` reads: the declared one, with the effects as terms."""

import itertools
import re
from typing import Any

import casadi
import numpy as np

from simpel_cli.data.estimation.smoother import speeds
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.verdict.groups import differing, spread_of, values_of
from simpel_cli.discovery.verdict.verdict import Z95, interval_of
from simpel_cli.filtering.likelihood.coordinates import LOG_UNIFORM
from simulators.effects import Term
from simulators.effects.term import BACKLASH, DELAY, LAG, ON_SENSOR, RATE_LIMIT, SENSOR, SENSOR_DELAY
from simulators.model import Declared, Model, ModelError
from simulators.quantity import HIDDEN, READING
from simulators.readings import line_of

DECLARED, EXTENDED = "simulators.model.Declared", "simulators.extended.Extended"
SHARE = 0.95  # of the interval that a prior has for its range
SURELY = 6.0  # standard deviations from zero beyond which a normal prior has one sign
STIFF = 8  # Runge-Kutta steps per row: groups at the far end of a population move faster than any that was seen
NAMES = ("states", "inputs", "parameters", "intermediates", "tables", "outputs")  # sections that introduce names
PAST = {
    BACKLASH: "the position within the play depends on all past inputs, which a single transition does not contain",
    RATE_LIMIT: "where the actuator is depends on all past inputs, which a single transition does not contain",
}
OWN = "it has a state of its own, and only a simulator in YAML without sensors can be given one more"
FOLLOWS = "a lagging reading follows what it reads by a law of its own, to which nothing is added"


def corrected(sim: dict[str, Any], model: Model, search: Search, trial: Trial) -> tuple[str, dict[str, Any], list[str]]:
    """Return name, YAML and what could not be written, each with the reason.

    Priors of the effects' parameters are normal, with the 95 % interval of the fit for range, or lognormal (see `law_of`), and
    likewise the spread of one that differs from group to group, and the value of every group; the simulator's own keep the
    ranges that the user declared.

    Args:
        sim: the `sim:` node, as declared.
        model: that it declares.
        search: that was run.
        trial: the chosen effects.
    """
    terms = [search.terms[t] for t in trial.terms]
    added = "_with_" + "_and_".join(t.effect for t in terms)
    by = {one.how.by for one in differing(search, trial) if not one.effect}
    name = sim["name"] + (added if terms else "_by_" + "_and_".join(sorted(by)) if by else "_in_wider_ranges")
    taken = {q.name for group in (model.states, model.inputs, model.params, model.outputs) for q in group}
    taken |= {*model.fixed, *(name for key in NAMES for name in sim.get(key) or {})}
    taken |= {store.name for t in terms for store in t.stores}
    readings = {q.name for q in model.states if q.role == READING}
    # where sensors are declared, terms act on what these show
    plain = sim.get("_target_", DECLARED) == DECLARED and not sim.get("sensors")
    own_outputs = (sim.get("outputs") or {}).keys() if plain else ()

    def why_not(term: Term) -> str | None:
        if term.stores and not plain:
            return OWN
        if term.stores and term.kind == SENSOR and term.acts_on in own_outputs:
            return None
        return FOLLOWS if readings & term.rates.keys() else PAST.get(term.kind) or no_line(term, model)

    cannot = {t: why_not(t) for t in terms}
    spread = {one.row: one for one in differing(search, trial)}
    written: list[Term] = []
    names: dict[str, str] = {}
    parameters: dict[str, Any] = {}
    for index, term in sorted(zip(trial.terms, terms, strict=True)):
        if cannot[term]:
            continue
        written.append(term)
        for parameter, row in zip(term.parameters, search.rows[index], strict=True):
            short = (
                parameter.label
                if parameter.label not in taken
                else f"{parameter.label}_{term.acts_on.replace(', ', '_')}"
            )
            short = short if short not in taken else parameter.name
            taken.add(short)
            names[parameter.name] = short
            span = interval_of(search, trial, row, Z95)
            low, high = sorted((span["low"], span["high"]))
            parameters[short] = span["value"]
            if low < high:
                law = law_of(low, high, signed=parameter.low < 0, log=parameter.prior == LOG_UNIFORM)
                parameters[short] = {"unit": parameter.unit} | law
            if row in spread and low < high:
                ends = spread_of(search, trial, spread[row], Z95)
                parameters[short] |= {"per": spread[row].how.by, "spread": [ends["low"], ends["high"]]}
                parameters[short]["groups"] = {
                    name: law_of(v["low"], v["high"], signed=parameter.low < 0, log=v["low"] > 0)["range"]
                    for name, v in values_of(search, trial, spread[row], SHARE).items()
                    if v["low"] < v["high"]
                }
    node = (_declared if plain else _extended)(sim, name, written, names, parameters)
    if plain and search.plan.substeps > int(sim.get("substeps", Declared.substeps)):
        node["substeps"] = search.plan.substeps  # which its parameters were fitted with
    sensors = shown(written, names, model, search.plan.augmented.measured)
    node |= {"sensors": sensors} if sensors else {}
    return name, node, [f"{t.label} ({cannot[t]})" for t in terms if cannot[t]]


def law_of(low: float, high: float, *, signed: bool, log: bool) -> dict[str, Any]:
    """Return the prior of a parameter with a 95 % interval: normal, unless its tail would leave what an effect can be.

    A lag, a delay or a stiffness below zero is no simulator, and some integrate to anything: there the prior is the lognormal
    one of the same mean and standard deviation.

    Args:
        low: end of the interval.
        high: the other.
        signed: whether the parameter may be below zero.
        log: whether its logarithm is what was estimated: the interval is that of a lognormal one.
    """
    middle, sd = (low + high) / 2, (high - low) / 4
    if log and low > 0:
        return {"range": [low, high], "prior": "lognormal"}
    if signed or middle > SURELY * sd:
        return {"range": [low, high], "prior": "normal"}
    wide = np.sqrt(np.log1p((sd / middle) ** 2))
    ends = middle * np.exp(-(wide**2) / 2 + np.array([-2.0, 2.0]) * wide)
    return {"range": ends.tolist(), "prior": "lognormal"}


def _extended(
    sim: dict[str, Any], name: str, terms: list[Term], names: dict[str, str], parameters: dict[str, Any]
) -> dict[str, Any]:
    """Return a simulator whose equations are in Python with the terms beside it, for `simulators.extended.Extended`."""
    inputs: dict[str, dict[str, str]] = {}
    dynamics: dict[str, str] = {}
    for term in terms:
        if term.kind in (DELAY, LAG):
            inputs.setdefault(term.acts_on, {})[term.kind] = names[term.parameters[0].name]
        for signal, text in term.inputs.items():
            before = inputs.setdefault(signal, {}).get("value", signal)
            inputs[signal]["value"] = _renamed(text, names | {signal: f"({before})"})
        for state, text in term.rates.items():
            own = {} if term.several else {"rate": f"rate_{state}"}
            added = f"({_renamed(text, names | own)})"
            dynamics[state] = f"{dynamics[state]} + {added}" if state in dynamics else added
    parts = {"parameters": parameters, "inputs": inputs, "dynamics": dynamics}
    return {"_target_": EXTENDED, "name": name, "base": sim, **{key: part for key, part in parts.items() if part}}


def _declared(
    sim: dict[str, Any], name: str, terms: list[Term], names: dict[str, str], parameters: dict[str, Any]
) -> dict[str, Any]:
    """Return a declared simulator with the terms, in the order in which they were attached, as the augmented model has them."""
    node = {key: dict(value) if isinstance(value, dict) else value for key, value in sim.items()}
    node["name"] = name
    if any("per" in own for own in parameters.values() if isinstance(own, dict)):
        node["substeps"] = max(int(sim.get("substeps", Declared.substeps)), STIFF)
    node["parameters"] = (node.get("parameters") or {}) | parameters
    given: dict[str, str] = {}
    for term in terms:
        if term.kind in (DELAY, LAG):
            own = node["inputs"][term.acts_on]
            node["inputs"][term.acts_on] = own | {term.kind: names[term.parameters[0].name]}
        for signal, text in term.inputs.items():
            given[signal] = f"({_renamed(text, names | {signal: given.get(signal, signal)})})"
    # the rates of the simulator with the changed inputs: every term adds to these, and takes its rates from these
    base = {state: _renamed(str(text), given) for state, text in node["dynamics"].items()}
    rates, rates_of = {f"rate_{state}": f"({text})" for state, text in base.items()}, set(base)
    node["dynamics"] = dict(base)
    for section in ("intermediates", "outputs"):
        for key, own in (node.get(section) or {}).items():
            new = _renamed(str(own["expression"] if isinstance(own, dict) else own), given)
            node[section][key] = own | {"expression": new} if isinstance(own, dict) else new
    _look_up_changed_inputs(node, given)
    for term in terms:
        for store in term.stores:
            node["states"][store.name] = {"unit": store.unit, "range": [store.low, store.high], "role": HIDDEN}
            node["dynamics"][store.name] = _renamed(store.rate, names | given)
        if term.stores and term.kind == SENSOR and term.acts_on in (node.get("outputs") or {}):
            own = node["outputs"][term.acts_on]
            before = own["expression"] if isinstance(own, dict) else own
            text = _renamed(term.expression, names | given | {term.acts_on: f"({before})"})
            node["outputs"][term.acts_on] = own | {"expression": text} if isinstance(own, dict) else text
    for term in terms:
        for state, text in term.rates.items():
            if state not in rates_of:
                continue
            swap = names | given | (rates if term.several else {"rate": rates[f"rate_{state}"]})
            node["dynamics"][state] += f" + ({_renamed(text, swap)})"
    return node


def no_line(term: Term, model: Model) -> str | None:
    """Return why a simulator cannot show what a sensor shows; None: it can, or the term is about something else."""
    if term.kind != SENSOR:
        return None
    try:
        _line(term, model)
    except ModelError:
        return f"a simulator shows a factor of {term.acts_on} and an offset, which depend on nothing but parameters"
    return None


def shown(
    terms: list[Term], names: dict[str, str], model: Model, measured: tuple[str, ...]
) -> dict[str, dict[str, str]]:
    """Return the section `sensors` of the corrected simulator.

    A speed that is not measured is read off what the sensor of its position shows: it has its factor, its lag and its delay.

    Args:
        terms: that are written.
        names: unique name of a parameter -> the one in the YAML.
        model: the simulator.
        measured: names of the measured states and outputs.
    """
    found: dict[str, dict[str, str]] = {}
    of_position = {p: v for v, positions in speeds(model).items() if v not in measured for p in positions}
    for term in terms:
        if term.kind not in (SENSOR, *ON_SENSOR) or term.stores:
            continue
        for place in (term.acts_on, *(v for p, v in of_position.items() if p == term.acts_on)):
            own = found.get(place, {})
            if term.kind in ON_SENSOR:
                key = "delay" if term.kind == SENSOR_DELAY else "lag"
                found[place] = own | {key: names[term.parameters[0].name]}
                continue
            before = own.get("value", place)
            at = {term.acts_on: before if before.isidentifier() else f"({before})"}
            value = _renamed(term.expression, names | at)
            if place != term.acts_on:
                slope, offset = _line(term, model)
                if slope.is_one():
                    continue
                value += "" if offset.is_zero() else f" - ({_renamed(term.expression, names | {term.acts_on: '0'})})"
            found[place] = own | {"value": value}
    return found


def _line(term: Term, model: Model) -> Any:
    """Return factor and offset of what a sensor shows, in symbols.

    Raises:
        ModelError: it is no line, or depends on more than parameters.
    """
    names = [q.name for q in model.params] + [k.name for k in term.parameters]
    scope = {name: casadi.SX.sym(name) for name in names}
    scope |= {name: casadi.SX(value) for name, value in model.fixed.items()}
    return line_of("", term.expression, term.acts_on, scope, casadi.SX)


def _look_up_changed_inputs(node: dict[str, Any], given: dict[str, str]) -> None:
    """Give a name to each changed input that a table has, since a table takes names only."""
    taken = {name for key in NAMES for name in node.get(key) or {}}
    acting: dict[str, str] = {}
    for key, table in (node.get("tables") or {}).items():
        for name in (name for name in table["inputs"] if name in given and name not in acting):
            free = next(n for i in itertools.count() if (n := f"{name}_acting{i or ''}") not in taken)
            acting[name] = free
            node["intermediates"] = (node.get("intermediates") or {}) | {free: given[name]}
        node["tables"][key] = table | {"inputs": [acting.get(name, name) for name in table["inputs"]]}


def _renamed(text: str, swap: dict[str, str]) -> str:
    return re.sub(r"(?<![\w.])[A-Za-z_]\w*", lambda m: swap.get(m[0], m[0]), text)
