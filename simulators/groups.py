"""A parameter that differs from group to group, such as the drag of each ball: values about a common one, a learned spread.

    c_g = c + s delta_g,    or, where c is positive throughout its range,    c_g = c exp(s delta_g),    delta_g ~ N(0, 1)

c and the spread s are parameters of the population, delta_g of a group. Which group a row is of, is an input per group that is
1 there and 0 elsewhere. The last of them is of a group that was never seen: no data tell of its delta, so that what is
predicted for it is the population, with its spread.

Reference: Gelman and Hill (2007), Data analysis using regression and multilevel/hierarchical models, ch. 12 (partial pooling).
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace

import casadi

from simulators.expression import Symbol
from simulators.model import Model, ModelError, column
from simulators.quantity import Quantity

UNSEEN = "another"  # the group of rows whose group was not trained on
DELTA = (-2.0, 2.0)  # +-2 standard deviations
SPREAD, MEMBER = "spread", "member"  # roles of parameters: of the population, of one group


def grouped(model: Model, groups: dict[str, tuple[str, ...]]) -> Model:
    """Return the model in which every parameter that differs `per` group does so.

    Args:
        model: with `per`: parameter -> column of the groups.
        groups: column -> names of its groups.

    Raises:
        ModelError: a parameter that cannot differ, or a name that is taken.

    """
    if not groups:
        return model
    for key, times in (("delay", model.delay), ("lag", model.lag)):
        for name, value in times.items():
            if value in model.per:
                raise ModelError(
                    f"sim.parameters.{value}.per: sim.inputs.{name}.{key} depends on it, and a {key} is the same for all "
                    "groups; leave `per` out"
                )
    slots = {by: [f"{by}_is_{word}" for word in words((*names, UNSEEN))] for by, names in groups.items()}
    inputs = [Quantity(name, "1", 0.0, 1.0) for names in slots.values() for name in names]
    taken = {q.name for q in (*model.states, *model.inputs, *model.params, *model.outputs)} | model.fixed.keys()
    own: list[Quantity] = []
    places: dict[int, tuple[bool, int, list[tuple[int, int]]]] = {}
    first = {name: len(model.inputs) + i for i, name in enumerate(q.name for q in inputs)}
    for i, q in enumerate(model.params):
        if q.name not in model.per:
            continue
        by = model.per[q.name]
        ratio = q.low > 0
        at = len(model.params) + len(own)
        own.append(Quantity(f"{q.name}_spread", "1" if ratio else q.unit, 0.0, _most(q, ratio=ratio), role=SPREAD))
        pairs = []
        for slot, word in zip(slots[by], words((*groups[by], UNSEEN)), strict=True):
            pairs.append((first[slot], len(model.params) + len(own)))
            own.append(Quantity(f"{q.name}_of_{word}", "1", *DELTA, prior="normal", role=MEMBER))
        places[i] = (ratio, at, pairs)
    for q in (*inputs, *own):
        if q.name in taken:
            raise ModelError(f"sim: the name {q.name} is needed for groups, but it is taken; choose another name")
    nu, n = len(model.inputs), len(model.params)

    def of_group(u: Symbol, p: Symbol) -> Symbol:
        """Return the parameters of the group that a row is of."""
        values = [p[i] for i in range(n)]
        for i, (ratio, spread, pairs) in places.items():
            off = p[spread] * sum((u[j] * p[k] for j, k in pairs[1:]), u[pairs[0][0]] * p[pairs[0][1]])
            values[i] = p[i] * casadi.exp(off) if ratio else p[i] + off
        return column(model.symbol, values)

    return replace(
        model,
        inputs=(*model.inputs, *inputs),
        params=(*model.params, *own),
        rhs=lambda x, u, p: model.rhs(x, u[:nu], of_group(u, p)),
        output=lambda x, u, p: model.output(x, u[:nu], of_group(u, p)),
        covariates=model.covariates | {name: by for by, names in slots.items() for name in names},
        coordinates=None,
        groups=groups,
        base=model,
    )


def spreads_of(params: Sequence[Quantity]) -> dict[int, list[int]]:
    """Return the rows of the spreads, and of what the groups are, without the group that was never seen."""
    found = {}
    for i, q in enumerate(params):
        if q.role == SPREAD:
            after = [k for k in range(i + 1, len(params)) if params[k].role != MEMBER]
            found[i] = list(range(i + 1, min(after, default=len(params)) - 1))
    return found


def slots_of(model: Model) -> tuple[tuple[int, ...], ...]:
    """Return the rows of the inputs that say which group a row is of, column by column."""
    first, found = len(model.inputs) - sum(len(names) + 1 for names in model.groups.values()), []
    for names in model.groups.values():
        found.append(tuple(range(first, first + len(names) + 1)))
        first += len(names) + 1
    return tuple(found)


def words(names: tuple[str, ...]) -> list[str]:
    """Return a word for every name that an expression can hold, no two alike."""
    found: list[str] = []
    for name in names:
        word = re.sub(r"\W+", "_", name).strip("_").replace("__", "_") or "group"
        found.append(word if word not in found else f"{word}_{len(found)}")
    return found


def _most(q: Quantity, *, ratio: bool) -> float:
    """Largest spread: half of the range, so that two standard deviations reach over all of it and more."""
    return math.log(q.high / q.low) / 2 if ratio else (q.high - q.low) / 2
