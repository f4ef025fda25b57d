"""Aligned Markdown tables, for terminal and file, and the same rows as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import printable
from tflane_jax.files.atomic import check_stem, write_text

Row = Mapping[str, Any]

# What numbers of scores are, for the "unit" of a table's "meta".
FRACTIONS, PERCENT, POINTS = "fractions; distances in metres", "percent; distances in metres", "points"


def format_table(rows: Sequence[Row], columns: Sequence[str] | None = None, *, title: str = "", digits: int = 3) -> str:
    """Return the rows as an aligned Markdown table; columns of numbers are right-aligned.

    Args:
        rows: cells by column; a missing one or None is shown as "-", NaN as "n/a".
        columns: to show, in this order; None shows all in order of appearance.
        title: line above the table, for example the metric's protocol and version.
        digits: decimals of floating-point numbers.

    Returns:
        The title alone if there is no column.
    """
    title = printable(title, "\n")
    names = list(columns) if columns is not None else list(dict.fromkeys(name for row in rows for name in row))
    if not names:
        return title
    cells = [[_cell(row.get(name), digits) for name in names] for row in rows]
    numeric = [
        any(_is_number(row.get(name)) for row in rows)
        and all(row.get(name) is None or _is_number(row.get(name)) for row in rows)
        for name in names
    ]
    widths = [max(3, len(name), *(len(line[i]) for line in cells)) for i, name in enumerate(names)]
    rule = ["-" * (width - 1) + ":" if right else "-" * width for width, right in zip(widths, numeric, strict=True)]
    lines = [_line(line, widths, numeric) for line in (names, rule, *cells)]
    return "\n".join([title, "", *lines] if title else lines)


def latex_table(rows: Sequence[Row], *, caption: str = "") -> str:
    """Return the rows as a LaTeX table for the package `booktabs`; cells as in `format_table`."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    numeric = [all(row.get(name) is None or _is_number(row.get(name)) for row in rows) for name in names]
    lines = [[_cell(row.get(name), 3).replace("\\|", "|") for name in names] for row in rows]
    body = [" & ".join(map(latex_text, line)) + r" \\" for line in (names, *lines)]
    return "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            *([rf"\caption{{{latex_text(caption)}}}"] if caption else []),
            rf"\begin{{tabular}}{{{''.join('r' if right else 'l' for right in numeric)}}}",
            r"\toprule",
            body[0],
            r"\midrule",
            *body[1:],
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def latex_text(text: str) -> str:
    """Return the text with LaTeX's special characters escaped."""
    return "".join(_LATEX.get(character, character) for character in text)


def save_table(
    stem: Path,
    rows: Sequence[Row],
    meta: Mapping[str, Any],
    *,
    columns: Sequence[str] | None = None,
    title: str = "",
    digits: int = 3,
) -> tuple[Path, Path]:
    """Write `<stem>.md` and `<stem>.json` ({"meta": ..., "rows": [...]}), each whole or not at all; return both paths.

    `columns` selects those of the Markdown table; the JSON file has all. NaN and infinity become null in JSON.

    Raises UserError where a file cannot be written.
    """
    stem = Path(stem)
    check_stem(stem)
    text = json.dumps({"meta": _plain(meta), "rows": _plain(rows)}, indent=1, allow_nan=False)
    table = format_table(rows, columns, title=title, digits=digits)
    return (
        write_text(stem.with_name(stem.name + ".md"), table + "\n"),
        write_text(stem.with_name(stem.name + ".json"), text + "\n"),
    )


def written_to(paths: Sequence[Path]) -> str:
    """Return the sentence that names the files of a command."""
    *first, last = map(str, paths)
    return f"written to {', '.join(first)} and {last}" if first else f"written to {last}"


def _line(cells: Iterable[str], widths: list[int], right: list[bool]) -> str:
    placed = (
        cell.rjust(width) if r else cell.ljust(width) for cell, width, r in zip(cells, widths, right, strict=True)
    )
    return "| " + " | ".join(placed) + " |"


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool)


def _cell(value: Any, digits: int) -> str:
    if value is None:
        return "-"
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (float, np.floating)):
        return "n/a" if math.isnan(value) else f"{value:.{digits}f}"
    # A bar would end the cell, a line break the table.
    return printable(str(value).replace("|", "\\|").replace("\n", " "))


_LATEX = {
    "\\": r"\textbackslash{}",
    "±": r"$\pm$",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
} | {character: f"\\{character}" for character in "&%$#_{}"}


def _plain(value: Any) -> Any:
    """Return the value in JSON's types; what has none becomes its `str`."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
