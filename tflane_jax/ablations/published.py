"""The page of results: made from the summaries of tables that are kept with the code, never edited by hand."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from tflane_jax.ablations.archive import merged, read_archive, write_archive
from tflane_jax.ablations.effect_records import Record, claim_row, judged_together, records_of
from tflane_jax.ablations.reuse import FILE, archive_path
from tflane_jax.ablations.tables import TABLES
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import write_text
from tflane_jax.files.fields import load_json, member
from tflane_jax.files.wording import counted
from tflane_jax.plots.claims import save_claims
from tflane_jax.plots.figure import can_draw
from tflane_jax.plots.tables import format_table

_WIDTH = 120
_CLAIMS = (
    "The difference is treatment minus control in the table's primary measure; p is corrected for the claims of the "
    "table, not for the number of tables. Negative controls and secondary measures stand with the tables below. Of an "
    "interim table, more seeds may change a verdict. The paper's difference is that of its own data, in the measure "
    "that stands beside it."
)


def record(summaries: Sequence[Path], folder: Path) -> Path:
    """Copy summaries (see `table_run`), if any, into the folder of results, write its page anew, and return the page.

    The page lies beside the folder: `docs/results` has `docs/results.md`. The runs of each table are added to those in
    `docs/results/scores`, and the pictures of `draw_claims` are drawn where matplotlib is installed. A summary with
    fewer seeds of a row than the one that is there does not replace it: its tests would be of fewer runs than are
    recorded.

    Raises:
        UserError: a summary is of a quick run or of an earlier version, or what was recorded before is damaged.
    """
    for path in summaries:
        content = load_json(path)
        if member(content, "quick", str(path)):
            raise UserError(f"{path} is of a quick run, which is a smoke test and no result")
        _check(content, path)
        name = member(content, "table", str(path))
        new, place = read_archive(path.with_name(FILE)), archive_path(folder, name)
        write_archive(place, merged(read_archive(place), new) if place.exists() else new)
        there, seeds = folder / f"{name}.json", set(member(content, "seeds", str(path)))
        before = load_json(there) if there.exists() else {}
        if before and (lost := _lost(before, content, there)):
            print(
                f"{name}: the runs of seeds {_listed(sorted(seeds))} were added to the record; its table stays that of "
                f"before, which also has {lost}. For a table of all: tflane tables {name} --from {folder} "
                f"--record {folder}, with --seeds for some of them"
            )
            continue
        if (remark := before.get("remark on runs")) and {*remark["commits"]} & {*content["commits"]}:
            content = {**content, "remark on runs": remark}
        write_text(there, json.dumps(content, indent=1) + "\n")
    written = write_text(folder.with_name(f"{folder.name}.md"), page(folder))
    if can_draw():
        draw_claims(folder)
    return written


def _lost(before: Mapping[str, Any], now: Mapping[str, Any], place: Path) -> str:
    """Return what a recorded summary has and another one lacks: seeds, or runs of a row; "" for nothing."""
    if seeds := sorted(set(member(before, "seeds", str(place))) - set(now["seeds"])):
        return f"seeds {_listed(seeds)}"
    there, here = (_seeds_by_row(summary) for summary in (before, now))
    fewer = [row for row, number in there.items() if row in here and here[row] < number]
    # Rows may have other names since; a name that both have, or that the new plan names, is the same row.
    gone = [row for row in there if row not in here and row in now.get("models", ())]
    return f"more runs of {(fewer + gone)[0]}" if fewer or gone else ""


def _seeds_by_row(summary: Mapping[str, Any]) -> dict[str, int]:
    """Return how many seeds each row has at the last checkpoint."""
    last = (row for row in summary["rows"] if row.get("checkpoint", "last") == "last")
    return {row["model"]: row.get("seeds", len(summary["seeds"])) for row in last}


def draw_claims(folder: Path) -> None:
    """Draw the claims of a folder of summaries: a picture for each group of tables, such as `markers.png`."""
    found = summaries(folder)
    headings = {name: (_heading(summary), _if_interim(summary)) for name, summary in found.items()}
    for group, claims in _drawn(found).items():
        save_claims(folder / f"{group}.png", claims, headings)


def _drawn(found: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, list[Record]]]:
    """Return the claims with a number, by group and table; a group is what stands before the first dot of a name."""
    groups: dict[str, dict[str, list[Record]]] = {}
    for name, summary in found.items():
        if claims := [record for record in summary["effects"] if record["difference"] is not None]:
            groups.setdefault(name.partition(".")[0], {})[name] = claims
    return groups


def page(folder: Path) -> str:
    """Return the page of a folder of summaries, in the order of the tables."""
    found = summaries(folder)
    lines = [
        "# Results",
        "",
        "Every table of the papers that was run here, in the built-in world. `tflane tables` writes this page from",
        "`docs/results/`; do not edit it. The papers' own numbers are of other data and stand there for orientation.",
        "A claim is *shown* or *contradicted* if the corrected p over seeds and the interval over scenes say so, else",
        "*not shown* ([how](comparisons.md)). Scores other than recall have no interval where an earlier version",
        "measured them: there p alone decides.",
    ]
    for remark, tables in _remarks_on_runs(found).items():
        lines += ["", *_wrapped(f"{', '.join(tables)}: {remark}")]
    linked = {f"[{name}](#{_anchor(each)}){_if_interim(each)}": each for name, each in found.items()}
    if claims := [claim_row(name, record) for name, each in linked.items() for record in each["effects"]]:
        lines += ["", "## All claims", "", *_wrapped(_CLAIMS + _declared_late(found)), ""]
        if together := judged_together({name: each["effects"] for name, each in found.items()}):
            lines += [*_wrapped(together), ""]
        lines.append(format_table(claims))
        for group in _drawn(found):
            lines += ["", f"![Claims of {group}]({folder.name}/{group}.png)"]
    remarked: dict[str, str] = {}  # the table that says it first, by remark
    for name, summary in found.items():
        note = summary.get("note")  # earlier summaries have none
        first = remarked.setdefault(note, name) if note else name
        lines += ["", *_section(summary, note if first == name else f"The remark on {first} holds here, too.")]
    if missing := [name for name in TABLES if name not in found]:
        lines += [
            "",
            "## Not run yet",
            "",
            *_wrapped(", ".join(f"`{name}` ({TABLES[name].title})" for name in missing)),
        ]
    return "\n".join(lines) + "\n"


def _remarks_on_runs(found: Mapping[str, Mapping[str, Any]]) -> dict[str, list[str]]:
    """Return the tables by the remark on their runs.

    It was written into a summary by hand, with the commits that it is about, and goes with the last run of these.
    """
    tables: dict[str, list[str]] = {}
    for name, summary in found.items():
        if remark := summary.get("remark on runs"):
            tables.setdefault(remark["remark"], []).append(name)
    return tables


def _declared_late(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a sentence that names the tables whose claims were declared when runs of theirs had begun; "" for none."""
    late = [f"{name} ({summary['runs begun']})" for name, summary in found.items() if summary["runs begun"]]
    if not late:
        return ""
    return (
        f" Claims of these tables were declared when some of their runs had begun (how many): {', '.join(late)}; what "
        "was known of them by then stands with their discussion."
    )


def summaries(folder: Path) -> dict[str, Mapping[str, Any]]:
    """Return the summaries of a folder by name, in the order of the tables.

    Raises UserError for another JSON file, and for a summary of an earlier version.
    """
    found = {path.stem: load_json(path) for path in folder.glob("*.json")}
    for name, summary in found.items():
        _check(summary, folder / f"{name}.json")
    return {name: found[name] for name in (*TABLES, *sorted(found.keys() - TABLES.keys())) if name in found}


def _check(summary: Any, path: Path) -> None:
    """Raise UserError for a file that is no summary, or one without what this version reads."""
    for field in ("table", "findings", "rows", "quoted", "commits"):
        member(summary, field, str(path))
    records_of(summary, str(path))
    member(summary, "runs begun", str(path))


def _heading(summary: Mapping[str, Any]) -> str:
    return f"{summary['table']}: {summary['title']}"


def _anchor(summary: Mapping[str, Any]) -> str:
    """Return the name by which GitHub links to the heading of a table."""
    return re.sub(r"[^\w\- ]", "", _heading(summary).lower()).replace(" ", "-")


def _between(numbers: Collection[float]) -> str:
    if not numbers:  # runs without records
        return "an unknown number of"
    least, most = round(min(numbers)), round(max(numbers))
    return str(least) if least == most else f"{least} to {most}"


def _updates(steps: Mapping[str, int] | Sequence[int]) -> str:
    """Return how many updates a run of each row made, from those by row; earlier summaries name no rows."""
    if not isinstance(steps, Mapping):
        return f"{' or '.join(map(str, steps))} updates a run"
    rows = {count: [name for name in steps if steps[name] == count] for count in sorted({*steps.values()})}
    usual = max(rows, key=lambda count: len(rows[count]))
    others = [f"{count} of {' and '.join(names)}" for count, names in rows.items() if count != usual]
    return f"{usual} updates a run" + (f" ({'; '.join(others)})" if others else "")


def _section(summary: Mapping[str, Any], note: str | None) -> list[str]:
    minutes = summary["core minutes of a run"]
    cores = _listed(summary["cores of a run"])
    rows = _without_repeated(summary["rows"])
    facts = (
        f"{_seeds(summary)}, {_updates(summary['steps'])}, each on {cores} "
        f"core{'' if cores == '1' else 's'} ({_listed(summary['devices'])}); the updates of a run took "
        f"{_between(minutes.values())} minutes (means of the rows), other work beside it; "
        f"code {_listed(summary['commits'])}. "
        f"{summary['protocol']}, test split of the built-in world, percent (mean ± std over seeds). "
        f"{summary['declared']}{_interim(summary)}"
    )
    facts = " ".join([facts, *summary.get("mixed hosts", ())])
    lines = [
        f"## {_heading(summary)}",
        "",
        "```",
        # Numbers depend on the cores of a run, which --jobs alone takes from the machine.
        f"tflane tables {summary['table']} --seeds {_seeds_option(summary)} --jobs 2{_cores_option(summary)}",
        "```",
        "",
        *_wrapped(facts),
        "",
        format_table(rows),
        "",
    ]
    if len(rows) < len(summary["rows"]):
        lines += ["Best checkpoints that score as the last are left out.", ""]
    if note:
        lines += [*_wrapped(note), ""]
    for finding in summary["findings"]:
        lines += _wrapped(f"{finding}.", first="- ", rest="  ")
    if remark := summary.get("remark on findings"):  # of an earlier version, whose sentences do not say it
        lines += ["", *_wrapped(remark)]
    quoted = summary["quoted"]
    if quoted["rows"]:
        lines += ["", *_wrapped(f"The paper's own numbers: {quoted['source']}."), ""]
        lines.append(format_table(quoted["rows"], digits=2))
    return lines


def _seeds(summary: Mapping[str, Any]) -> str:
    """Return how many seeds a table has, as a range where rows differ, and which they are if not 0, 1, 2, ..."""
    seeds, (least, most) = summary["seeds"], _fewest_and_most(summary)
    number = counted(most, "seed") if least == most else f"{least} to {most} seeds"
    return number if list(seeds) == list(range(most)) else f"{number} ({_listed(seeds)})"


def _seeds_option(summary: Mapping[str, Any]) -> str:
    seeds = summary["seeds"]
    if list(seeds) == list(range(len(seeds))):
        return str(len(seeds))
    return ",".join(map(str, seeds)) if len(seeds) > 1 else f"{seeds[0]}-{seeds[0]}"


def _interim(summary: Mapping[str, Any]) -> str:
    """Return a sentence for a table of which a row has fewer seeds than it declares; "" for one with all."""
    return f" **Interim**: {lacking} declared seeds." if (lacking := _lacking(summary)) else ""


def _if_interim(summary: Mapping[str, Any]) -> str:
    """Return the same as a remark behind the name of a table."""
    return f", interim: {lacking} seeds" if (lacking := _lacking(summary)) else ""


def _lacking(summary: Mapping[str, Any]) -> str:
    """Return how many seeds the rows have, "2 of 5", where one has fewer than the table declares; else ""."""
    (least, most), table = _fewest_and_most(summary), TABLES.get(summary["table"])
    declared = summary.get("declared seeds", most if table is None else table.seeds)  # earlier summaries have none
    count = str(most) if least == most else f"{least} to {most}"
    return f"{count} of {declared}" if least < declared else ""


def _fewest_and_most(summary: Mapping[str, Any]) -> tuple[int, int]:
    """Return how many seeds the rows have that have the fewest, and how many the table has."""
    most, found = len(summary["seeds"]), _seeds_by_row(summary)
    missing = [0 for model in summary.get("models", ()) if model not in found]  # earlier summaries name no models
    return min([*found.values(), *missing], default=most), most


def _cores_option(summary: Mapping[str, Any]) -> str:
    cores = summary["cores of a run"]
    return f" --cores {cores[0]}" if len(cores) == 1 else ""


def _without_repeated(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the rows without those of a best checkpoint that show what the last checkpoint's row shows."""
    last = {row["model"]: row for row in rows if row["checkpoint"] == "last"}

    def repeats(row: Mapping[str, Any]) -> bool:
        shown = last.get(row["model"], {})
        return row["checkpoint"] != "last" and all(
            shown.get(column) == cell for column, cell in row.items() if column != "checkpoint"
        )

    return [row for row in rows if not repeats(row)]


def _listed(values: Sequence[Any]) -> str:
    return ", ".join(map(str, values))


def _wrapped(text: str, first: str = "", rest: str = "") -> list[str]:
    return textwrap.wrap(
        text, _WIDTH, initial_indent=first, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
    )
