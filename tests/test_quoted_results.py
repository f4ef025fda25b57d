"""Numbers that pages quote from tables: those of docs/results, docs/controls and docs/carry_over, cell by cell.

A quoting table stands below `<!-- results: NAME -->`, which names the recorded table. Its columns and rows have shorter
names than there, which this file translates.
"""

import fnmatch
import json
import re

import pytest

from tests.shared import ROOT
from tflane_jax.ablations.effect_records import claim_row
from tflane_jax.ablations.effects import DIFFERENCE as OF_THE_TWO
from tflane_jax.ablations.findings import points

PAGES = (
    "README.md",
    "docs/tf_lane.md",
    "docs/tf_lane_results.md",
    "docs/marker_results.md",
    "docs/cameras.md",
    "docs/small_models.md",
    "docs/real_roads.md",
    "docs/gtn_lane.md",
)
# The least count of numbers in sentences that must be those of findings; docs/real_roads.md quotes others in brackets.
FINDINGS = {
    "README.md": 4,
    "docs/tf_lane_results.md": 30,
    "docs/marker_results.md": 12,
    "docs/small_models.md": 0,
    "docs/gtn_lane.md": 42,
}
COLUMNS = {
    "DET_l": "all/DET_l",
    "TOP_ll": "all/TOP_ll",
    "recall": "all/recall",
    **{name: f"all/{name}" for name in ("mAP", "AP_ls", "AP_ped", "TOP_lsls", "OLS", "DET_t", "Accuracy", "FP", "FN")},
    "hidden, driven along": "hidden+traffic/recall",
    "recall, hidden lanes that vehicles drove along": "hidden+traffic/recall",
    "hidden, no vehicle near": "hidden-traffic/recall",
    "DET_l, occluded lanes": "occluded/DET_l",
    "recall, board in sight": "seen/recall",
    "recall, gap": "gap/recall",
}
# The same names in tables of vector maps.
LINE_COLUMNS = {
    **{name: f"lines/{name}" for name in ("mAP", "AP_divider", "AP_ped_crossing", "AP_boundary")},
    "hidden, driven along": "lines hidden+traffic/recall",
    "hidden, no vehicle near": "lines hidden-traffic/recall",
}
# What rows add to the host, which stands in the first row.
ON_HOST = {
    "+ TFM (the paper)": " + TFM",
    "+ TFM, in the queries as in the paper": " + TFM",
    "+ TFM + BEV (ours)": " + TFM + BEV",
    "+ TFM, and traffic in the BEV features (ours)": " + TFM + BEV",
}
# Rows about the model of the row above that has a name of its own.
ADDED = {
    "- none at inference": ", no traffic flow at inference",
    "- of another scene": ", traffic of another scene",
    "- of another log": ", traffic of another log",
    "the same, traffic of another scene at inference": ", traffic of another scene",
    "- control: trained without traffic": ", control",
    "the same, trained without traffic (control)": ", control",
}
NUMBER = r"[+-]?\d+\.\d+"
# "7.6 points over the control (+5.9 to +9.3, p = 0.02" and "(+6.1 points over the control, p = 0.003)".
INTERVAL = re.compile(rf"({NUMBER})([^()\d]*)\(({NUMBER}) to ({NUMBER})(?:[^()]*?, p [=<] (\d\.\d+))?")
DIFFERENCE = re.compile(rf"\(({NUMBER})\s+points[^()\d]*, p = (\d\.\d+)\)")


def summaries():
    """Return the recorded tables by name."""
    folders = ROOT / "docs" / "results", ROOT / "docs" / "controls"
    paths = [
        *(path for folder in folders for path in folder.glob("*.json")),
        ROOT / "docs" / "carry_over" / "carry_over.json",
    ]
    return {path.stem: {"effects": [], **json.loads(path.read_text(encoding="utf-8"))} for path in paths}


def tables(text):
    """Yield line above, header and rows of every table of a page, the rows as lists of cells without emphasis."""
    lines = [*text.splitlines(), ""]
    starts = [i for i, line in enumerate(lines[:-1]) if line.startswith("|") and not lines[i - 1].startswith("|")]
    for start in starts:
        end = next(i for i in range(start, len(lines)) if not lines[i].startswith("|"))
        header, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines[start:end])
        above = next((line for line in reversed(lines[:start]) if line), "")
        yield above, header, [[cell.replace("*", "") for cell in row] for row in rows]


def wrong_tables(text, recorded):
    """Return what is wrong with the quoting tables of a page, and how many cells they have."""
    wrong, count = [], 0
    for above, header, rows in tables(text):
        if not any("±" in cell for row in rows for cell in row):
            continue
        named = re.fullmatch(r"<!-- results: (\S+) -->", above)
        if named is None or named[1] not in recorded:
            wrong.append(f"a table with the row {rows[0]} does not name a recorded table, but has: {above}")
            continue
        found = {row["model"]: row for row in recorded[named[1]]["rows"] if row.get("checkpoint", "last") == "last"}
        host = main = ""
        for label, *cells in rows:
            if label in ADDED:
                name = main + ADDED[label]
            elif label in ON_HOST:
                name = main = host + ON_HOST[label]
            else:
                own = [row for row in found if re.match(rf"{re.escape(row)}($|[,:] )", label)]
                name = main = max(own, key=len, default=label)
                host = host or name
            if name not in found:
                wrong.append(f"{named[1]} has no row {name}")
                continue
            for column, cell in zip(header[1:], cells, strict=True):
                count += 1
                columns = LINE_COLUMNS if "lines/mAP" in found[name] else COLUMNS
                if cell != (there := str(found[name].get(columns.get(column, column)))):
                    wrong.append(f"{named[1]}, {name}, {column}: {cell} is quoted, {there} recorded")
    return wrong, count


def wrong_sentences(text, recorded):
    """Return what is wrong with the differences and intervals that a page tells, and how many numbers were compared."""
    effects = [
        _as_told(numbers, effect["measure"])
        for summary in recorded.values()
        for effect in summary["effects"]
        for numbers in (effect, *effect["further"])
        if numbers["difference"] is not None
    ]
    told = [(m[0], m[1] if m[1][0] in "+-" else None, m[1], m[3], m[4], m[5]) for m in INTERVAL.finditer(text)]
    told += [(m[0], m[1], m[1], None, None, m[2]) for m in DIFFERENCE.finditer(text)]
    wrong, count = [], 0
    for words, signed, plain, low, high, p in told:
        count += sum(number is not None for number in (plain, low, high, p))
        same = [
            e
            for e in effects
            if (_rounds(e[0], signed) if signed else _rounds(abs(e[0]), plain))
            and all(
                number is None or _rounds(value, number) for value, number in zip(e[1:], (low, high, p), strict=True)
            )
        ]
        if not same:
            wrong.append(f"no recorded finding has these numbers: {' '.join(words.split())}")
    return wrong, count


def _as_told(numbers, primary):
    """Return difference, ends of the interval and p as the page of results tells them, from which others quote."""
    factor, unit = points(primary if numbers["measure"] == OF_THE_TWO else numbers["measure"])
    assert unit == "points"
    ends = [
        None if numbers[name] is None else round(factor * numbers[name], 2) for name in ("difference", "low", "high")
    ]
    p = numbers.get("p below", numbers["p"])
    return [*ends, None if p is None else max(round(p, 4), 1e-4)]


def _rounds(value, text):
    """Return whether a recorded number, itself rounded, rounds to a quoted one."""
    return value is not None and abs(value - float(text)) <= 0.5 * 10.0 ** -len(text.partition(".")[2]) + 1e-9


@pytest.mark.parametrize("page", PAGES)
def test_quoted_numbers_are_the_recorded_ones(page):
    text, recorded = (ROOT / page).read_text(encoding="utf-8"), summaries()
    wrong, cells = wrong_tables(text, recorded)
    assert wrong == []
    assert cells >= 20
    if page in FINDINGS:
        wrong_told, numbers = wrong_sentences(text, recorded)
        assert wrong_told == []
        assert numbers >= FINDINGS[page]


@pytest.mark.parametrize("page", PAGES)
def test_a_changed_digit_is_found(page):
    """Of each cell one digit is changed, of the next one the next digit; of intervals every digit."""
    text, recorded = (ROOT / page).read_text(encoding="utf-8"), summaries()
    cells = list(re.finditer(r"\d+\.\d ± \d+\.\d(?=\**\s*\|)", text))
    for number, cell in enumerate(cells):
        digits = [place for place in range(cell.start(), cell.end()) if text[place].isdigit()]
        assert wrong_tables(_changed(text, digits[number % len(digits)], 1), recorded)[0], cell[0]
    for told in re.finditer(rf"\({NUMBER} to {NUMBER}", text):
        for place in range(told.start(), told.end()):
            if text[place].isdigit():
                assert wrong_sentences(_changed(text, place, 5), recorded)[0], told[0]


def _changed(text, place, by):
    return text[:place] + str((int(text[place]) + by) % 10) + text[place + 1 :]


def test_a_row_or_a_table_without_its_source_is_found():
    recorded, page = summaries(), (ROOT / "docs/tf_lane_results.md").read_text(encoding="utf-8")
    for old, new, words in (
        ("<!-- results: tf_lane.2 -->", "With learned queries:", "does not name a recorded table"),
        ("<!-- results: tf_lane.2 -->", "<!-- results: tf_lane.9 -->", "does not name a recorded table"),
        ("| + TFM (the paper) |", "| + TFM |", "has no row + TFM"),
        ("- of another scene", "- none at inference", "is quoted"),
    ):
        assert old in page
        assert any(words in line for line in wrong_tables(page.replace(old, new), recorded)[0])


# Cells such as "**shown +7.67**"; "not tested" and "-" quote no number.
VERDICT = re.compile(r"(shown|not shown|contradicted) ([+-]\d+\.\d\d)")


def wrong_verdicts(text, recorded):
    """Return what is wrong with the tables below `<!-- verdicts: PATTERN ... -->`, and how many cells they quote.

    The last columns quote findings of the tables that match the patterns, in their order; a cell that quotes none must
    say so. Below `<!-- verdicts by row: PATTERN ... -->` only the last column quotes, each row by a pattern of its own.
    PATTERN=MODEL stands for findings about this treatment.
    """
    wrong, count = [], 0
    for above, header, rows in tables(text):
        if named := re.fullmatch(r"<!-- verdicts( by row)?: (.+) -->", above):
            patterns = named[2].split()
            of_rows = [[name] for name in patterns] if named[1] else [patterns] * len(rows)
            for row, quoted in zip(rows, of_rows, strict=True):
                columns, cells = header[-len(quoted) :], row[-len(quoted) :]
                for column, pattern, cell in zip(columns, quoted, cells, strict=True):
                    of_tables, _, treatment = pattern.partition("=")
                    names = fnmatch.filter(recorded, of_tables)
                    found = {
                        f"{told['verdict']} {told['difference'].removesuffix(' points')}"
                        for name in names
                        for effect in recorded[name]["effects"]
                        if treatment in ("", effect["treatment"]) and (told := claim_row(name, effect))["difference"]
                    }
                    count += bool(VERDICT.fullmatch(cell))
                    if cell not in found | {"not tested", "-"}:
                        wrong.append(f"{row[0]}, {column}: {cell} is no finding of {', '.join(names)}")
    return wrong, count


@pytest.mark.parametrize(
    ("page", "least"), [("README.md", 12), ("docs/tf_lane_results.md", 16), ("docs/marker_results.md", 22)]
)
def test_verdicts_are_the_recorded_ones(page, least):
    text, recorded = (ROOT / page).read_text(encoding="utf-8"), summaries()
    wrong, count = wrong_verdicts(text, recorded)
    assert wrong == []
    assert count >= least
    for cell in VERDICT.finditer(text):
        other = "shown" if cell[1] != "shown" else "not shown"
        assert wrong_verdicts(text[: cell.start()] + other + text[cell.end(1) :], recorded)[0], cell[0]
        assert wrong_verdicts(_changed(text, cell.end() - 1, 5), recorded)[0], cell[0]


# Columns of the tables below `<!-- sweep: NAME -->`: model and score, in the files of docs/sweeps.
SWEEPS = {
    "marker_jumps": [
        (model, score) for score in ("all/DET_l", "seen/recall") for model in ("gated", "uniform", "hard")
    ],
    "marker_density": [
        (model, score)
        for score in ("all/DET_l", "occluded/recall", "seen/recall", "before/recall")
        for model in ("gated", "toponet")
    ],
}


@pytest.mark.parametrize("name", SWEEPS)
def test_tables_of_sweeps_are_the_recorded_ones(name):
    page = (ROOT / "docs" / "marker_results.md").read_text(encoding="utf-8")
    recorded = json.loads((ROOT / "docs" / "sweeps" / f"{name}.json").read_text(encoding="utf-8"))
    values, scores = map(float, recorded["meta"]["values"]), recorded["meta"]["scores"]
    (rows,) = (rows for above, _, rows in tables(page) if above == f"<!-- sweep: {name} -->")
    for i, (value, (label, *cells)) in enumerate(zip(values, rows, strict=True)):
        assert float(label.removesuffix(" %")) == pytest.approx(100 * value if "%" in label else value)
        for (model, score), cell in zip(SWEEPS[name], cells, strict=True):
            mean = sum(seed[score] for seed in scores[model][i]) / len(scores[model][i])
            assert _rounds(100 * mean, cell), (label, model, score)
