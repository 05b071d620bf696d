"""Parameters of the simulator that lie outside the ranges that it declares."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.verdict.verdict import interval_of
from simulators.model import Model


class Beyond(NamedTuple):
    """A parameter of the simulator that lies outside the range it was given.

    Args:
        name: of it.
        unit: of it.
        range: given.
        value, low, high: estimate and 90 % interval.
        gain: nats by which the evidence of the model is ahead of that within the ranges that were given, all of them together.
    """

    name: str
    unit: str
    range: tuple[float, float]
    value: float
    low: float
    high: float
    gain: float


def beyond(model: Model, search: Search, chosen: Trial, gain: float) -> list[Beyond]:
    """Return the parameters of the simulator that lie outside the ranges that it declares.

    Args:
        model: as it was declared.
        search: with wider ranges.
        chosen: the model that it chose.
        gain: nats of evidence of the wider ranges.
    """
    given = {q.name: q for q in model.params}
    found = []
    for row, q in enumerate(search.plan.augmented.model.params):
        declared = given.get(q.name)
        if declared is None or (declared.low, declared.high) == (q.low, q.high):
            continue
        at = interval_of(search, chosen, row)
        if not declared.low <= at["value"] <= declared.high:
            found.append(
                Beyond(q.name, q.unit, (declared.low, declared.high), at["value"], at["low"], at["high"], gain)
            )
    return found


def sentence_of(found: Sequence[Beyond]) -> str:
    """Return what a verdict says of parameters outside their ranges."""
    if not found:
        return ""
    parts = [f"{b.name} = {b.value:.3g} ({b.low:.3g}..{b.high:.3g}) {b.unit}, given {b.range[0]:.3g}..{b.range[1]:.3g}"
             for b in found]  # fmt: skip
    gain = found[0].gain
    # where simulations have chosen, the evidence of the ordinary search may say otherwise
    by = f", by {gain:.0f} nats" if gain > 0 else ""
    return f" Outside the range that sim.parameters gives{by}: {'; '.join(parts)}."


def ranges_of(found: Sequence[Beyond]) -> dict[str, dict[str, Any]]:
    """Return what a `sim:` node has to say of them: ranges that hold what was given and what was found."""
    return {b.name: {"range": [min(b.range[0], b.low), max(b.range[1], b.high)]} for b in found}
