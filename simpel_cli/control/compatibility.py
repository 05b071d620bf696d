"""Whether a policy that was learned for one system can be driven and judged in another."""

import math

from simpel_cli.control.task import Goal
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError
from simulators.model import Model
from simulators.worlds.world import World


def check_compatible(
    key: str, other: Model | World, encoding: Encoding, goal: Goal, dt: float, *, by_name: bool = False
) -> None:
    """Refuse a system of other quantities, units, angles or steps, or one that does not take the commands.

    Args:
        key: that names the other system.
        other: the system.
        encoding: quantities of the simulator that is learned with.
        goal: of the task, whose limits the commands have.
        dt: s, of the simulator.
        by_name: whether the other system may have an order of its own, and states that the simulator does not have.

    Raises:
        ConfigError: names the quantity.
    """
    for what in ("states", "inputs"):
        have, need = ({q.name: q for q in getattr(system, what)} for system in (other, encoding))
        named = set(need) <= set(have) if what == "states" else set(need) == set(have)
        if not (named if by_name else list(have) == list(need)):
            raise ConfigError(
                f"{key}: {what} of {other.name} are {', '.join(have)}; those of sim are {', '.join(need)}."
            )
        for name, own in need.items():
            its = have[name]
            if its.unit and own.unit and its.unit != own.unit:
                raise ConfigError(f"{key}: {name} of {other.name} is in {its.unit}; that of sim is in {own.unit}.")
            if its.periodic != own.periodic:
                one, two = (("an angle" if q.periodic else "no angle") + " (periodic)" for q in (its, own))
                raise ConfigError(f"{key}: {name} of {other.name} is {one}; that of sim is {two}.")
    for i, q in enumerate(encoding.inputs):
        ways = [
            i in encoding.linear,
            isinstance(other, Model) and q.name in [other.inputs[k].name for k in other.linear],
        ]
        if ways[0] != ways[1]:
            its_word = other.between_rows.get(q.name, "held") if isinstance(other, Model) else "held"
            own_word = "held" if ways[1] else "linear or smooth"
            raise ConfigError(
                f"{key}: {q.name} of {other.name} is {its_word} between rows; that of sim is {own_word}. Say the same of both "
                f"(inputs.{q.name}.between_rows), or data.between_rows={{{q.name}: {its_word}}}."
            )
    if not math.isclose(other.dt, dt, rel_tol=1e-6):
        raise ConfigError(f"{key}: a step of {other.name} is {other.dt:g} s; one of sim is {dt:g} s.")
    takes = {q.name: q for q in other.inputs}
    for own, low, high in zip(encoding.inputs, goal.low, goal.high, strict=True):
        q = takes[own.name]
        if low < q.low or high > q.high:
            raise ConfigError(
                f"{key}: {q.name} of {other.name} takes [{q.low:g}, {q.high:g}] {q.unit}; the commands have "
                f"[{low:g}, {high:g}]. Set reward.limits.{q.name}."
            )
