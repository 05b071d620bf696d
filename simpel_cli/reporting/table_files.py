"""Tables for papers and spreadsheets: LaTeX with booktabs, CSV."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from simpel_cli.runs.files import write_text

ESCAPED = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"} | {
    c: f"\\{c}" for c in "&%$#_{}"
}


def write_csv(path: Path, head: Sequence[str], rows: Sequence[Sequence[object]]) -> Path:
    """Write a table as CSV, numbers in full."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    write_text(path, text.getvalue())
    return path


def write_latex(path: Path, caption: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> Path:
    """Write a table as LaTeX (needs `booktabs`), cells as they are shown, escaped."""
    body = [r"\begin{table}", r"\centering", rf"\caption{{{_escaped(caption)}}}"]
    body += [rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}", r"\toprule", _line(head), r"\midrule"]
    body += [*map(_line, rows), r"\bottomrule", r"\end{tabular}", r"\end{table}"]
    write_text(path, "\n".join(body) + "\n")
    return path


def _line(cells: Sequence[str]) -> str:
    return " & ".join(map(_escaped, cells)) + r" \\"


def _escaped(text: str) -> str:
    return "".join(ESCAPED.get(character, character) for character in text).replace("±", r"$\pm$")
