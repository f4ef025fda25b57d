"""Markdown tables, and files of tables."""

import json
import math

import numpy as np
import pytest

from tflane_jax.plots.tables import format_table, latex_table, save_table, written_to

ROWS = [
    {"model": "baseline", "DET_l": 0.25, "lanes": 7, "best": False},
    {"model": "+TFM", "DET_l": np.float32(0.5), "lanes": np.int64(12), "best": True, "note": "a|b"},
]


def test_columns_are_aligned_with_numbers_right_aligned():
    assert format_table(ROWS, title="OpenLane-V2 v2.1") == "\n".join(
        [
            "OpenLane-V2 v2.1",
            "",
            "| model    | DET_l | lanes | best | note |",
            "| -------- | ----: | ----: | ---- | ---- |",
            "| baseline | 0.250 |     7 | no   | -    |",
            "| +TFM     | 0.500 |    12 | yes  | a\\|b |",
        ]
    )


def test_columns_and_decimals_are_chosen():
    assert format_table(ROWS, ["DET_l", "model"], digits=1).splitlines()[2:] == [
        "|   0.2 | baseline |",
        "|   0.5 | +TFM     |",
    ]


@pytest.mark.parametrize(("value", "shown"), [(None, "-"), (math.nan, "n/a"), (math.inf, "inf"), ("a\nb", "a b")])
def test_cells_without_a_number(value, shown):
    assert format_table([{"x": value}]).splitlines()[-1].strip("| ") == shown


def test_texts_of_files_control_no_terminal_and_make_no_lines():
    table = format_table([{"scene": "a\x1b[2J\n# b|c\r", "n": 1}])
    assert len(table.splitlines()) == 3
    assert format_table([], title="a\x1b[2J\n\nb") == "a\\x1b[2J\n\nb"
    assert r"| a\x1b[2J # b\|c\r |" in table


def test_without_rows_the_table_has_a_header_only_and_without_columns_nothing():
    assert format_table([], ["a"]) == "| a   |\n| --- |"
    assert format_table([], title="a title") == "a title"


def test_latex_has_its_special_characters_escaped():
    rows = [{"all/DET_l": "45.5 ± 0.8", "model": "a|b {50 %}"}, {"model": "~x^2 & \\#$"}]
    assert latex_table(rows, caption="TOP_ll") == "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            r"\caption{TOP\_ll}",
            r"\begin{tabular}{ll}",
            r"\toprule",
            r"all/DET\_l & model \\",
            r"\midrule",
            r"45.5 $\pm$ 0.8 & a|b \{50 \%\} \\",
            r"- & \textasciitilde{}x\textasciicircum{}2 \& \textbackslash{}\#\$ \\",
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def test_both_files_hold_the_rows(tmp_path):
    rows = [{"x": np.float64(1.5), "y": math.nan, "z": np.arange(2), "path": tmp_path}]
    text, data = save_table(tmp_path / "deep" / "table.v1", rows, {"seed": np.int32(3)}, title="T")
    assert text.name == "table.v1.md"
    assert text.read_text().startswith("T\n\n|")
    assert json.loads(data.read_text()) == {
        "meta": {"seed": 3},
        "rows": [{"x": 1.5, "y": None, "z": [0, 1], "path": str(tmp_path)}],
    }
    assert len(list(text.parent.iterdir())) == 2
    assert written_to([text, data]) == f"written to {text} and {data}"
    assert written_to([text]) == f"written to {text}"
