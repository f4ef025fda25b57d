"""Arguments of `tflane data` and `tflane cache`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tflane_jax.commands.arguments.shared import OVERRIDES, SourceName, command, source_arguments, split_arguments, stem


def data(commands) -> None:
    """Add `tflane data`."""
    parser = commands.add_parser(
        "data", help="show, check and convert datasets", description="Show, check and convert datasets."
    )
    inner = parser.add_subparsers(dest="what", required=True, metavar="COMMAND")
    for add in (_show, _stats, _check, _export, _maps, _overlap, _build):
        add(inner)


def _show(inner) -> None:
    show = command(
        inner,
        "show",
        "draw samples of a dataset and count their content",
        module="data",
        function="show",
        epilog=OVERRIDES,
    )
    show.add_argument(
        "--config", metavar="FILE[:NAME]", help="config file whose data to show (default: the built-in world)"
    )
    split_arguments(show, "train")
    show.add_argument("--count", type=int, default=8, help="examples (default 8)")
    show.add_argument(
        "--out", metavar="FILE", type=Path, default=Path("samples.png"), help="picture (default samples.png)"
    )
    show.set_defaults(takes_overrides=True)


def _stats(inner) -> None:
    stats = command(
        inner,
        "stats",
        "count lanes, evidence and traffic of a split",
        module="data_stats",
        function="stats",
        epilog=OVERRIDES,
    )
    stats.add_argument("--config", metavar="FILE[:NAME]", help="config file whose data to count")
    split_arguments(stats, "test")
    stats.add_argument("--count", type=int, default=400, help="examples, spread evenly (default 400)")
    stats.add_argument(
        "--beside",
        metavar="NAME[=PATH]",
        action="append",
        default=[],
        help="also count these data and compare the distributions; PATH is their folder. May be repeated",
    )
    stats.add_argument("--out", metavar="STEM", type=stem, help="with --beside: write STEM.md, STEM.json and STEM.png")
    stats.set_defaults(takes_overrides=True)


def _check(inner) -> None:
    check = command(
        inner, "check", "count the content of a dataset's folder and list its faults", module="data", function="check"
    )
    check.add_argument("root", metavar="PATH", help="folder of the dataset")
    check.add_argument(
        "--format",
        metavar="NAME",
        type=SourceName(checked=True),
        help="format of the dataset (default argoverse2)",
    )
    check.add_argument(
        "--tracks",
        metavar="PATH",
        type=Path,
        help="folder of the source logs of OpenLane-V2's segments: count and check the traffic flow, too",
    )
    check.add_argument(
        "--whole-images",
        action="store_true",
        help="read OpenLane-V2's images as a whole, not only header and end: finds damage within a file, takes hours",
    )
    check.add_argument("--all", action="store_true", help="list every fault and entry skipped, not the first 50")


def _export(inner) -> None:
    export = command(
        inner,
        "export",
        "write a dataset with cameras in another format",
        module="data_export",
        function="run",
        epilog=OVERRIDES,
    )
    export.add_argument("--format", choices=("openlane-v2",), default="openlane-v2", help="default openlane-v2")
    export.add_argument("--config", metavar="FILE[:NAME]", help="config file whose data to write", required=True)
    source_arguments(export)
    export.add_argument(
        "--splits", choices=("train", "val", "test"), nargs="+", default=["train", "val"], help="default train val"
    )
    export.add_argument(
        "--images",
        choices=("jpg", "png"),
        default="jpg",
        help="jpg like the official data, or lossless png (default jpg)",
    )
    export.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to write")
    export.add_argument(
        "--tracks",
        metavar="DIR",
        type=Path,
        help="also write the road users' tracks and the ego poses, as Argoverse 2 logs (seven cameras) or nuScenes' "
        "tables (six)",
    )
    export.set_defaults(takes_overrides=True)


def _maps(inner) -> None:
    maps = command(
        inner,
        "maps",
        "draw a frame of each recorded log beside a simulated one on its map",
        module="data_maps",
        function="run",
    )
    maps.add_argument("root", metavar="FOLDER", type=Path, help="logs of Argoverse 2 or scenes of nuScenes")
    maps.add_argument("--logs", metavar="LOG", nargs="+", default=[], help="names of logs (default: all)")
    maps.add_argument("--scene", metavar="N", type=int, default=0, help="number of the simulated scene (default 0)")
    maps.add_argument(
        "--moment", type=_moment, default=0.7, help="time in the recorded log, 0 to below 1 (default 0.7)"
    )
    maps.add_argument("--out", metavar="FILE", type=Path, default=Path("maps.png"), help="picture (default maps.png)")


def _overlap(inner) -> None:
    overlap = command(
        inner,
        "overlap",
        "measure how much two splits overlap geographically",
        module="data",
        function="overlap_of_splits",
    )
    overlap.add_argument(
        "train",
        metavar="TRAIN",
        type=Path,
        help="folder of Argoverse 2 logs, of OpenLane-V2 segments, of nuScenes or of its scene files (npz)",
    )
    overlap.add_argument(
        "validation",
        metavar="VALIDATION",
        type=Path,
        help="the same for the validation split; of nuScenes, the same folder stands for the official splits",
    )
    overlap.add_argument("--out", metavar="STEM", type=stem, help="write STEM.md and STEM.json")


def _build(inner) -> None:
    build = command(
        inner,
        "build",
        "generate the built-in world's examples before training",
        module="data",
        function="build",
        epilog=OVERRIDES,
    )
    build.add_argument("--config", metavar="FILE[:NAME]", help="config file (default: the built-in world)")
    build.set_defaults(takes_overrides=True)


def cache(commands) -> None:
    """Add `tflane cache`."""
    text = "list or delete what is kept between runs: examples of the built-in world, programs, weights"
    parser = commands.add_parser("cache", help=text, description=f"{text[0].upper()}{text[1:]}.")
    inner = parser.add_subparsers(dest="what", required=True, metavar="COMMAND")
    where = "Entries lie in the folder named by TFLANE_CACHE (default ~/.cache/tflane_jax)."
    command(inner, "list", "list the entries, with size and age", module="cache", function="show", epilog=where)
    clear = command(inner, "clear", "delete entries", module="cache", function="clear", epilog=where)
    chosen = clear.add_mutually_exclusive_group(required=True)
    chosen.add_argument("names", metavar="NAME", nargs="*", default=[], help="as `tflane cache list` gives them")
    chosen.add_argument(
        "--older", metavar="DAYS", type=float, help="delete all entries but weights that were not used for so long"
    )
    chosen.add_argument("--all", action="store_true", help="delete all entries but weights")


def _moment(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 0 to below 1")
    return value
