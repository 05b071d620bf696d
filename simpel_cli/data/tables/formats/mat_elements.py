"""Whether the elements of a MATLAB file of version 5 to 7 fit together: scipy's reader trusts what stands in their tags.

A file is a row of elements: a tag (type, number of bytes) and data. A variable is an element of type MATRIX, made of flags,
dimensions, name and contents, which are elements again. A wrong type in a damaged file makes scipy read outside its memory
(scipy/scipy#25349), which ends the process; what is compressed has a checksum.
"""

import math
import struct
from collections.abc import Iterator
from typing import NamedTuple

HEADER = 128  # bytes
MATRIX, COMPRESSED = 14, 15
INT8, INT32, UINT32, UTF8 = 1, 5, 6, 16
NUMBERS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}
TEXTS = {1, 2, 3, 4, 16, 17, 18}
TYPES = NUMBERS | TEXTS | {MATRIX, COMPRESSED}
CELL, STRUCT, OBJECT, CHAR, SPARSE, FUNCTION, OPAQUE = 1, 2, 3, 4, 5, 16, 17
NUMERIC = range(6, 16)
COMPLEX = 0x08
DEEPEST = 50  # structs in structs


class Element(NamedTuple):
    """One element: type, where its data begin and end, where the next one begins."""

    kind: int
    start: int
    end: int
    following: int


def check_elements(content: bytes) -> None:
    """Walk through a file.

    Raises:
        ValueError: it is no file of version 5 to 7, or damaged.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("no file of version 5")
    for element in _elements(content, HEADER, len(content), order):
        if element.kind == MATRIX:
            _check_variable(content, element, order, 0)
        elif element.kind != COMPRESSED:
            raise ValueError("an element that is no variable")


def _elements(content: bytes, start: int, end: int, order: str) -> Iterator[Element]:
    while start < end:
        if start + 8 > end:
            raise ValueError("a tag is cut off")
        kind, size = struct.unpack_from(f"{order}II", content, start)
        if kind >> 16:  # up to 4 bytes, in the tag itself
            kind, size = kind & 0xFFFF, kind >> 16
            element = Element(kind, start + 4, start + 4 + size, start + 8)
            if size > 4:
                raise ValueError("a short element is too long")
        else:
            padding = 0 if kind in (COMPRESSED, MATRIX) else -size % 8
            element = Element(kind, start + 8, start + 8 + size, start + 8 + size + padding)
        if element.kind not in TYPES or element.end > end:
            raise ValueError("an element of an unknown type, or beyond the end")
        yield element
        start = element.following


def _check_variable(content: bytes, variable: Element, order: str, depth: int) -> None:
    if variable.start == variable.end:
        return  # an empty matrix inside a cell
    if depth > DEEPEST:
        raise ValueError("structs in structs without end")
    parts = list(_elements(content, variable.start, variable.end, order))
    flags = parts[0]
    if flags.kind != UINT32 or flags.end - flags.start != 8:
        raise ValueError("a variable without flags")
    word = struct.unpack_from(f"{order}I", content, flags.start)[0]
    kind, is_complex = word & 0xFF, bool(word >> 8 & COMPLEX)
    inside = parts[1:]
    if kind != OPAQUE:
        if len(parts) < 3 or parts[1].kind not in (INT32, UINT32) or parts[2].kind not in (INT8, UTF8):
            raise ValueError("a variable without dimensions or name")
        count = _count(content, parts[1], order)
        inside = parts[3:]
        _check_contents(content, kind, count, is_complex, inside, order)
    for part in inside:
        if part.kind == MATRIX:
            _check_variable(content, part, order, depth + 1)
        elif part.kind == COMPRESSED:
            raise ValueError("something compressed inside a variable")


def _count(content: bytes, dimensions: Element, order: str) -> int:
    number, rest = divmod(dimensions.end - dimensions.start, 4)
    sizes = struct.unpack_from(f"{order}{number}i", content, dimensions.start)
    if rest or number < 2 or min(sizes) < 0:
        raise ValueError("wrong dimensions")
    return math.prod(sizes)


def _check_contents(content: bytes, kind: int, count: int, is_complex: bool, inside: list[Element], order: str) -> None:
    kinds = [part.kind for part in inside]
    if kind in NUMERIC or kind == CHAR:
        allowed = TEXTS | NUMBERS if kind == CHAR else NUMBERS
        good = len(inside) <= 1 + is_complex and set(kinds) <= allowed and (len(inside) > is_complex or count == 0)
    elif kind == SPARSE:
        good = len(inside) == 3 + is_complex and set(kinds) <= NUMBERS
    elif kind == CELL:
        good = set(kinds) <= {MATRIX} and len(inside) == count
    elif kind in (STRUCT, OBJECT):
        good = _is_struct(content, inside[kind == OBJECT :], count, order)
    else:
        good = kind == FUNCTION
    if not good:
        raise ValueError(f"contents that do not fit a variable of class {kind}")


def _is_struct(content: bytes, inside: list[Element], count: int, order: str) -> bool:
    """Whether there are the length of names, the names, and a value for each name of each struct."""
    if len(inside) < 2 or inside[0].kind != INT32 or inside[0].end - inside[0].start != 4 or inside[1].kind != INT8:
        return False
    length = struct.unpack_from(f"{order}i", content, inside[0].start)[0]
    size = inside[1].end - inside[1].start
    fields = size // length if length > 0 else -1
    return (
        length > 0
        and size % length == 0
        and {p.kind for p in inside[2:]} <= {MATRIX}
        and len(inside) - 2 == fields * count
    )
