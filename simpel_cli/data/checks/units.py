"""Units of columns against units of the simulator, and angles."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from simpel_cli.data.config import Measurements
from simpel_cli.data.recording import Check
from simpel_cli.data.tables.table import Table
from simpel_cli.data.timing.joined_tables import Joined
from simpel_cli.data.unit_words import canonical
from simpel_cli.errors import DataError
from simulators.model import Quantity


def read_card(path: Path) -> tuple[dict[str, str], Path | None]:
    """Units that a `card.yaml` beside the data file declares, column -> unit, and the card if there is one.

    Raises:
        DataError: the card is no YAML, or its `columns` are not a mapping.
    """
    card = path.with_name("card.yaml")
    if not card.is_file():
        return {}, None
    try:
        content = yaml.safe_load(card.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"{card} is not valid YAML.") from error
    columns = (content or {}).get("columns") if isinstance(content or {}, dict) else None
    if columns is not None and not isinstance(columns, dict):
        raise DataError(f"{card}: `columns` should be a mapping such as {{phi: {{unit: rad}}}}.")
    described = {name: about for name, about in (columns or {}).items() if isinstance(about, dict) and "unit" in about}
    return {str(name): str(about["unit"] or "") for name, about in described.items()}, card


def check_units(
    config: Measurements,
    table: Table,
    measured: dict[str, str],
    quantities: tuple[Quantity, ...],
    joined: Sequence[Joined] = (),
    home: Mapping[str, int] | None = None,
) -> tuple[Check, tuple[Path, ...]]:
    """Compare every declared unit with the simulator's; the data YAML wins over the file, the file over the card.

    Args:
        config: declares units per quantity.
        table: declares units per column, as may a card beside each of its files.
        measured: quantity -> column.
        quantities: all quantities of the simulator.
        joined: tables of other sensors.
        home: quantity -> which of them has its column; the others are in `table`.

    Returns:
        The check, and the cards that were read.

    Raises:
        DataError: units differ; the message names both and, for angles, the factor.
    """
    compared: set[str] = set()
    cards: dict[Path, None] = {}
    home = home or {}
    of_main = [*([config.time] if config.time is not None else []), *config.times.values()]
    tables = [(None, table, of_main), *((i, other.table, [other.time]) for i, other in enumerate(joined))]
    for which, sheet, stamps in ((which, sheet, stamps) for which, t, stamps in tables for sheet in t.sheets):
        of_card, card = read_card(sheet.path)
        cards |= {card: None} if card is not None else {}
        of_column = of_card | sheet.units
        for time in stamps:
            if canonical(of_column.get(time) or "s") != "s":
                raise DataError(f"column '{time}' of {sheet.path.name} is in {of_column[time]}, but time is read in s.")
        for quantity in quantities:
            column = measured.get(quantity.name) if home.get(quantity.name) == which else None
            unit = config.units.get(quantity.name, of_column.get(column) if column is not None else None)
            if column is None or not unit or not quantity.unit:  # one of them is not stated
                continue
            compared.add(quantity.name)
            if canonical(unit) != canonical(quantity.unit):
                raise DataError(_mismatch(sheet.path, column, unit, quantity))
    return Check("units", True, _declared(len(compared), len(measured))), tuple(cards)


def period(quantity: Quantity) -> float | None:
    """Length of a full turn in the quantity's unit, None where it is not periodic."""
    if not quantity.periodic:
        return None
    return 360.0 if canonical(quantity.unit) == "deg" else 2 * math.pi


def _declared(compared: int, measured: int) -> str:
    if compared == 0:
        return "no column declares a unit: the simulator's units are assumed"
    rest = "" if compared == measured else "; the simulator's units are assumed for the others"
    return f"{compared} of {measured} columns declare a unit, the same as the simulator's{rest}"


def _mismatch(path: Path, column: str, unit: str, quantity: Quantity) -> str:
    message = (
        f"unit of column '{column}' in {path.name} is {unit}, but the simulator has '{quantity.name}' "
        f"in {quantity.unit}."
    )
    given, wanted = canonical(unit), canonical(quantity.unit)
    for turn, other, factor in (("deg", "rad", "pi/180"), ("rad", "deg", "180/pi")):
        if given.replace(turn, other, 1) == wanted and turn in given:
            return f"{message} Multiply the column by {factor}, so that it is in {quantity.unit}."
    return f"{message} Convert the column, or correct data.units.{quantity.name} if the unit is declared wrongly."
