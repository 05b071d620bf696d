"""What an answer is worth: the outcome of one set, from its truth and the tool's verdict.

right: the name, or only such as no data of this system can tell from it; tie: several names of which one is right, or one name
of which it is said that these data cannot tell it from the two that are planted; twin: only a name that no data can tell from
the planted one; part: one of two; wrong: a name that is not there; nothing, unexplained.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

RIGHT, TIE, TWIN, PART, WRONG, HEDGED = "right", "tie", "twin", "part", "wrong", "hedged"
NOTHING, UNEXPLAINED, FALSE, ERROR = "nothing", "unexplained", "false effect", "error"
NESTED = {  # a special case of the planted effect is no error where the data do not ask for more
    "stribeck_friction": "coulomb_friction",
    "asymmetric_friction": "coulomb_friction",
    "ambient_exchange": "leak",
    "outflow_exponent": "leak",
}
ACCEPT = 4.5  # nats
CLEAR = 10.0  # nats of the oracle: what should be found
ORDER = (RIGHT, TIE, TWIN)

Gains = Mapping[tuple[str, str], float]  # (effect, place) -> evidence of the first step


def outcome(truth: Mapping[str, Any], found: Mapping[str, Any], gains: Gains | None = None) -> str:
    """Compare a verdict with the truth.

    Args:
        truth: of the set.
        found: `verdict.json`.
        gains: evidence of the candidates in the first step.
    """
    allowed = {tuple(pair) for pair in truth.get("may_be", ())}  # a nuisance of a sensor may be named as such
    kind = truth["kind"]
    # of a class that holds both, the planted effect is asked for
    asked = {(name, p["acts_on"]) for p in truth["effects"] for name in p["accept"]} if kind != "none" else set()
    classes = [{(m["name"], m["acts_on"]) for m in e.get("class_members", [])} for e in found["effects"]]
    claimed = [e for e, own in zip(found["effects"], classes, strict=True) if own & asked or not own & allowed]
    if kind == "none":
        left = found["verdict"] == "unexplained" or found["remainder"]
        return FALSE if claimed else UNEXPLAINED if left else RIGHT
    if kind == "outside":
        if found["remainder"]:
            return RIGHT
        return WRONG if claimed else RIGHT if found["verdict"] == "unexplained" else NOTHING
    if not claimed:
        return UNEXPLAINED if found["verdict"] == "unexplained" else NOTHING
    planted = list(truth["effects"])
    open_, grades = list(range(len(planted))), []
    for effect in claimed:
        judged = [(_grade(effect, planted[i], gains or {}), i) for i in range(len(planted))]
        judged = [(g, i) for g, i in judged if g in ORDER and (i in open_ or kind == "shape")]
        if len(open_) == len(planted) and not judged and _said_to_be(effect, planted, allowed):
            grades.append(TIE)
            open_ = []
            continue
        if not judged:
            return HEDGED if kind == "shape" and found["remainder"] else WRONG
        grade, i = min(judged, key=lambda pair: ORDER.index(pair[0]))
        grades.append(grade)
        open_ = [j for j in open_ if j != i]
    return PART if open_ else max(grades, key=ORDER.index)


def _said_to_be(
    effect: Mapping[str, Any], planted: Sequence[Mapping[str, Any]], allowed: Collection[tuple[str, str]]
) -> bool:
    """Whether it is said of an effect that these data cannot tell it from the two that are there, one maybe a nuisance."""
    same = [
        {(n, p["acts_on"]) for n in p["accept"]} | {tuple(t.split("@")) for t in p["twins"]} for p in planted
    ]  # fmt: skip
    same += [{*allowed}] if len(same) == 1 else []
    return any(
        (first["name"], first["acts_on"]) in same[i] and (second["name"], second["acts_on"]) in same[1 - i]
        for first, second in effect.get("same_as_two", ())
        for i in (0, 1)
    )


def _grade(effect: Mapping[str, Any], planted: Mapping[str, Any], gains: Gains) -> str:
    """Grade one claimed effect against one planted effect."""
    names = [(m["name"], m["acts_on"]) for m in effect.get("class_members", [])]
    names = names or [(n, effect.get("class_acts_on", {}).get(n, effect["acts_on"])) for n in effect["class"]]
    own = {(n, planted["acts_on"]) for n in planted["accept"]}
    twins = {tuple(t.split("@")) for t in planted["twins"]}
    same = set(effect.get("same_as", []))
    told = bool(same & set(planted["accept"]))  # that its own name and the planted one are the same to any data
    holds = told or any(n in own for n in names)
    known = own | twins | ({names[0]} if told else set())
    strangers = [n for n in names if n not in known and n[0] not in same]
    if holds:
        return TIE if strangers else RIGHT
    if not strangers:
        return TWIN
    special = (NESTED.get(planted["name"], ""), planted["acts_on"])
    true = gains.get((planted["name"], planted["acts_on"]), -np.inf)
    if special in names and true - gains.get(special, np.inf) < ACCEPT:
        return TIE
    return WRONG


def answered(found: Mapping[str, Any]) -> list[str]:
    """Names that were given, one string per effect."""
    return ["|".join(e["class"]) for e in found["effects"]]


def evidence(
    truth: Mapping[str, Any], graded: str, found: Mapping[str, Any], gains: Gains, oracle: Mapping | None
) -> float:
    """Return the least evidence of a planted effect: what its own fit earned, the oracle's where the tool was not right."""
    if truth["kind"] == "outside":
        return float(truth["visible"])
    if not truth["effects"]:
        return float("nan")
    if graded == RIGHT:
        return float(min(e["log_evidence_gain"] for e in found["effects"]))
    if len(truth["effects"]) == 1:
        own = own_gain(truth["effects"][0], gains)
        if np.isfinite(own):
            return float(own)
    earned = {(e["name"], e["acts_on"]): e["log_evidence_gain"] for e in oracle["effects"]} if oracle else {}
    each = [max(earned.get((n, e["acts_on"]), 0.0) for n in e["accept"]) for e in truth["effects"]]
    return float(min(each))


def error_ratio(found: Mapping[str, Any], other: Mapping[str, Any] | None, side: str = "after") -> float:
    """Return held-out 20-step errors of `other` over those of `found`, geometric mean over the channels; 1 = as good."""
    mine = found["error"]["after"]["horizon"]
    theirs = (other or found)["error"][side]["horizon"]
    logs = [np.log(theirs[n] / mine[n]) for n in mine if mine[n] and theirs[n] and np.isfinite(theirs[n] / mine[n])]
    return float(np.exp(np.mean(logs))) if logs else float("nan")


def covered(truth: Mapping[str, Any], graded: str, found: Mapping[str, Any]) -> tuple[int, int]:
    """Count the intervals that hold the true value, and all that were counted, where the model is the true one.

    A parameter that the data leave open (an interval wider than half of its range) says nothing and is not counted.
    """
    if graded != RIGHT or truth["kind"] not in ("none", "one", "two"):
        return 0, 0
    pairs: list[tuple[float, Mapping[str, float]]] = []
    for name, known in truth["parameters"].items():
        given = found["parameters"][name]["after"]
        if given["high"] - given["low"] < 0.5 * (known["range"][1] - known["range"][0]):
            pairs.append((known["value"], given))
    for planted in truth["effects"] if truth["world"] == "own" else []:
        for effect in found["effects"]:
            if (effect["name"], effect["acts_on"]) == (planted["name"], planted["acts_on"]):
                pairs += [
                    (v, effect["parameters"][n]) for n, v in planted["parameters"].items() if n in effect["parameters"]
                ]
    return sum(p["low"] <= v <= p["high"] for v, p in pairs), len(pairs)


def needs_oracle(truth: Mapping[str, Any], graded: str, gains: Gains) -> bool:
    """Whether the tool has to be asked again with the planted names alone: not where the first step shows too little."""
    if truth["kind"] not in ("one", "two", "shape") or graded in (RIGHT, ERROR):
        return False
    return len(truth["effects"]) > 1 or not -np.inf < own_gain(truth["effects"][0], gains) < CLEAR


def own_gain(planted: Mapping[str, Any], gains: Gains) -> float:
    """Evidence of a planted effect in the first step; -inf where it was not fitted."""
    return max(gains.get((n, planted["acts_on"]), -np.inf) for n in planted["accept"])


def names(truth: Mapping[str, Any]) -> Sequence[str]:
    """Names that an oracle is given."""
    return list(dict.fromkeys(n for e in truth["effects"] for n in e["accept"]))
