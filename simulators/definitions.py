"""Names that stand for expressions of other names: derived parameters, intermediates, tables; in an order of evaluation."""

from collections.abc import Callable, Iterable, Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Any, NamedTuple

import casadi

from simulators.expression import ExpressionError, Symbol, symbols_used
from simulators.quantity import (
    ModelError,
    Quantity,
    check_keys,
    check_mapping,
    read_expression,
    read_number,
    read_range,
    read_term,
    read_uncertain,
    read_unit,
    refuse_unknown,
)

INTERMEDIATE = ("unit", "expression")
KNOWN, UNCERTAIN = ("unit", "value"), ("unit", "range", "prior", "per", "spread", "groups")  # of a parameter
COVARIATE = ("unit", "range", "column")  # of one that is known in every row


class Definition(NamedTuple):
    """A name that stands for an expression of other names.

    Args:
        path: key path, for messages.
        uses: the other names.
        build: what every name stands for -> the expression.
    """

    path: str
    uses: frozenset[str]
    build: Callable[[Mapping[str, Symbol]], Symbol]


def expression_of(path: str, formula: Any) -> Definition:
    """Return the definition that a formula, or a number, is.

    Raises:
        ModelError: it is not an expression.
    """
    try:
        uses = symbols_used(formula) if isinstance(formula, str) else set()
    except ExpressionError as error:
        raise ModelError(f"{path}: {error}") from None
    return Definition(path, frozenset(uses), lambda scope: read_term(path, formula, scope))


def in_order(definitions: Mapping[str, Definition], cure: str) -> dict[str, Definition]:
    """Return the definitions so that each comes after those that it uses.

    Args:
        definitions: by name.
        cure: of a circle, for the message.

    Raises:
        ModelError: they go round in a circle.
    """
    try:
        order = list(TopologicalSorter({name: d.uses for name, d in definitions.items()}).static_order())
    except CycleError as error:
        loop = list(reversed(error.args[1]))
        section = definitions[loop[0]].path.rpartition(".")[0]
        raise ModelError(f"{section}: derived in a circle, {' -> '.join(loop)}; {cure}") from None
    return {name: definitions[name] for name in order if name in definitions}


def evaluated(definitions: Mapping[str, Definition], scope: Mapping[str, Symbol]) -> dict[str, Symbol]:
    """Return the scope and, in their order, the definitions."""
    known = dict(scope)
    for name, definition in definitions.items():
        known[name] = definition.build(known)
    return known


def read_intermediates(nodes: Mapping[str, Any]) -> dict[str, Definition]:
    """Read `intermediates`: an expression, or {unit, expression}."""
    found = {}
    for name, node in nodes.items():
        path = f"sim.intermediates.{name}"
        if isinstance(node, Mapping):
            check_keys(path, node, INTERMEDIATE)
            read_unit(path, node)
        found[name] = expression_of(path, read_expression(path, node))
    return found


def read_parameters(
    nodes: Mapping[str, Any],
) -> tuple[tuple[Quantity, ...], dict[str, float], dict[str, Definition]]:
    """Read `parameters`: the uncertain ones, the known numbers, and the derived ones in an order of evaluation."""
    uncertain: list[Quantity] = []
    fixed: dict[str, float] = {}
    formulas: dict[str, Definition] = {}
    for name, node in nodes.items():
        path = f"sim.parameters.{name}"
        if isinstance(node, str):
            formulas[name] = expression_of(path, node)
            _refuse_others(formulas[name], nodes)
        elif not isinstance(node, Mapping):
            fixed[name] = read_number(path, node)
        elif "value" in node:
            check_keys(path, node, KNOWN, "a known parameter takes no range")
            read_unit(path, node)
            fixed[name] = read_number(f"{path}.value", node["value"])
        elif "column" not in node:
            check_keys(path, node, UNCERTAIN, "`value: <number>` in place of a range makes it known")
            uncertain.append(read_uncertain(path, name, node))
    derived: dict[str, Definition] = {}
    for name, definition in in_order(formulas, "give one of them a number or a range").items():
        if definition.uses <= fixed.keys():
            fixed[name] = float(definition.build({other: casadi.SX(value) for other, value in fixed.items()}))
        else:
            derived[name] = definition
    return tuple(uncertain), fixed, derived


def read_groupings(
    nodes: Mapping[str, Any],
) -> tuple[dict[str, str], dict[str, tuple[float, float]], dict[str, dict[str, tuple[float, float]]]]:
    """Read which uncertain parameters differ from group to group.

    Returns:
        Parameter -> column of the groups, -> range of the spread, and -> group -> range of its value, where they are given.
    """
    found, spreads, known = {}, {}, {}
    for name, node in nodes.items():
        for key in ("spread", "groups"):
            if isinstance(node, Mapping) and key in node and "per" not in node:
                raise ModelError(
                    f"sim.parameters.{name}.{key}: only of a parameter that differs between groups; add `per: COLUMN`, or "
                    "leave it out"
                )
        if isinstance(node, Mapping) and "groups" in node:
            path = f"sim.parameters.{name}.groups"
            check_mapping(path, node["groups"])
            known[name] = {str(group): read_range(path, node["groups"], group) for group in node["groups"]}
        if isinstance(node, Mapping) and "spread" in node:
            path = f"sim.parameters.{name}.spread"
            low, high = read_range(f"sim.parameters.{name}", node, "spread")
            if low < 0:
                raise ModelError(f"{path}: low = {low:g} is negative, and a standard deviation is not; give 0 or more")
            spreads[name] = (low, high)
        if isinstance(node, Mapping) and "per" in node:
            if not isinstance(node["per"], str) or not node["per"].isidentifier():
                raise ModelError(
                    f"sim.parameters.{name}.per: {node['per']!r} is not the name of a column (letters, digits, underscores)"
                )
            found[name] = node["per"]
    return found, spreads, known


def read_covariates(nodes: Mapping[str, Any]) -> tuple[tuple[Quantity, ...], dict[str, str]]:
    """Read the parameters that a column of the measurements knows, such as a payload: quantities, and their columns."""
    found, columns = [], {}
    for name, node in nodes.items():
        if not (isinstance(node, Mapping) and "column" in node):
            continue
        path = f"sim.parameters.{name}"
        check_keys(path, node, COVARIATE, "a parameter that a column knows has no value and no prior")
        if not isinstance(node["column"], str) or not node["column"]:
            raise ModelError(f"{path}.column: {node['column']!r} is not the name of a column")
        found.append(Quantity(name, read_unit(path, node), *read_range(path, node)))
        columns[name] = node["column"]
    return tuple(found), columns


def _refuse_others(definition: Definition, parameters: Iterable[str]) -> None:
    known = list(parameters)
    for other in sorted(definition.uses - set(known)):
        refuse_unknown(definition.path, f"uses {other}, which is no parameter", other, known)
