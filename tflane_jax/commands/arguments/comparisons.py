"""Arguments of the commands that compare and score: compare, tables, carry-over, sweep, score, demo, bench."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from tflane_jax.commands.arguments.shared import OVERRIDES, command, stem

_FILES = """Protocols and their files:
  openlane-v2.1-centerline, openlane-v1.0-centerline
      PREDICTIONS is the pickle of an OpenLane-V2 submission; GROUND_TRUTH the devkit's collected pickle, or the
      dataset's folder with SPLIT/SEGMENT/info/TIMESTAMP.json, of which the predicted splits are read. The versions
      differ in TOP_ll and TOP_lt, by a factor of about four: say which one you report. v2.1 is also the metric of
      devkit v1.1. Both files may also be plain .npz, as `tflane predict` writes, or .json of another form
      (docs/scoring.md), without traffic elements.
  openlane-v2.1-lane-segment, lanesegnet
      The same files of the lane-segment task (TIMESTAMP-ls.json). The first gives the devkit's OLUS, the second the
      mAP of the LaneSegNet and TF-Lane papers.
  openlane-v2-f-score
      The files of the centerline protocols; the devkit's F-score of 3-D lanes.
  maptr, maptrv2, maptrv2-3d, maptr-iou, maptrv2-iou
      MapTR's nuscmap_results.json and the *_map_anns_val.json that its evaluation writes; -iou matches lines by the
      overlap of their buffers.
  tusimple, tusimple-lstr
      Both files have one JSON record per line: raw_file, lanes (x at every row, negative without a point), h_samples
      (ground truth) or run_time in ms (predictions). tusimple-lstr allows 20 s per image instead of 200 ms, as LSTR."""

_MOST_SEEDS = 1000


def _seeds(text: str) -> Sequence[int]:
    """Return the seeds of "8", which are 0 to 7, or of a list such as "0,4-7"."""
    bounds = [part.split("-") for part in text.split(",")]
    if any(len(ends) > 2 or not all(end.isdecimal() and len(end) < 10 for end in ends) for ends in bounds):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of seeds nor a list of seeds such as 0,4-7")
    listed = [range(int(ends[0]), int(ends[-1]) + 1) for ends in bounds]
    ranges = [range(int(text))] if bounds == [[text]] else listed
    if not all(map(len, ranges)) or sum(map(len, ranges)) > _MOST_SEEDS:
        raise argparse.ArgumentTypeError(f"{text}: at least one, at most {_MOST_SEEDS}; a list is 0,1,2")
    return sorted({seed for each in ranges for seed in each})


def compare(commands) -> None:
    """Add `tflane compare`."""
    parser = command(
        commands,
        "compare",
        "train configurations with several seeds and test their differences",
        module="compare",
        function="run",
        epilog=OVERRIDES,
    )
    parser.add_argument(
        "configs",
        metavar="[NAME=]FILE[:ABLATION]",
        nargs="+",
        help="config files; the others are compared with the first one. One argument may also hold settings of this "
        "row, such as 'NAME=FILE --optim.lr 1e-3'",
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="the seeds, not their number (default 0 1 2 3 4)"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="number of trainings at a time, which share the cores (default 1)"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/compare"), help="default runs/compare")
    parser.add_argument(
        "--test",
        metavar="NAME='SETTINGS'",
        action="append",
        default=[],
        help="evaluate on a further test set, for example --test rain='--data.world.severity 1'; may be repeated",
    )
    parser.add_argument(
        "--retrain", action="store_true", help="delete runs of other configurations in --out, and train again"
    )
    declared = parser.add_argument_group("declared comparison", "written to --out before the trainings")
    declared.add_argument(
        "--primary", metavar="GROUP/SCORE", help="score that decides, for example hidden+traffic/recall"
    )
    declared.add_argument(
        "--treatment", metavar="NAME", help="configuration whose effect is tested (default: the second of two)"
    )
    declared.add_argument(
        "--negative-control",
        metavar="GROUP/SCORE",
        help="score on which the treatment should change nothing, for example hidden-traffic/recall",
    )
    declared.add_argument(
        "--secondary", metavar="GROUP/SCORE", help="score that is tested as well, with a correction of its own"
    )
    declared.add_argument("--alpha", type=float, help="level of the corrected tests (default 0.05)")
    parser.set_defaults(takes_overrides=True)


def tables(commands) -> None:
    """Add `tflane tables`."""
    parser = command(
        commands,
        "tables",
        "train, evaluate and test a table of one of the papers; without a name, list the tables",
        module="tables",
        function="run",
    )
    parser.add_argument("names", metavar="TABLE", nargs="*", help="name of a table, such as tf_lane.1")
    parser.add_argument(
        "--seeds",
        metavar="N|LIST",
        type=_seeds,
        help="number of seeds (default: that of the table), or which, such as 0,4-7 or 3-3",
    )
    parser.add_argument(
        "--jobs",
        type=int,
        help="number of trainings at a time, which share the cores (default 1; with --quick, one for each of 2 cores)",
    )
    parser.add_argument(
        "--steps-factor",
        metavar="N",
        type=int,
        default=1,
        help="train every run N times as long, into a folder of its own (TABLE.steps_xN)",
    )
    parser.add_argument(
        "--cores",
        metavar="N",
        type=int,
        help="cores of each training, on which its numbers depend (default: all, shared between --jobs)",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="a few updates on a few scenes: a smoke test of some minutes, mostly compiling; no result",
    )
    parser.add_argument(
        "--search",
        action="store_true",
        help="instead of the table, its declared search for learning rates, on validation data",
    )
    parser.add_argument(
        "--record",
        metavar="DIR",
        type=Path,
        help="copy the summaries and the scores of all runs to DIR and write DIR.md anew; without a table, only write "
        "DIR.md; the repository keeps docs/results",
    )
    parser.add_argument(
        "--from",
        dest="source",
        metavar="DIR",
        type=Path,
        help="take the runs that are recorded in DIR (docs/results, or an earlier --out) instead of training them",
    )
    parser.add_argument(
        "--together",
        action="store_true",
        help="train the runs of all named tables, seed by seed, before any table is written: no worker waits for one",
    )
    parser.add_argument(
        "--finished",
        action="store_true",
        help="train nothing: make the table of the runs that are complete, whatever cores or GPU trained them",
    )
    parser.add_argument(
        "--device",
        choices=("cpu", "gpu"),
        help="with --finished, take runs of this kind of device (default: that whose runs test the most)",
    )
    parser.add_argument(
        "--earlier-scores",
        action="store_true",
        help="keep scores of complete runs that an earlier state of the code measured (default: measure again)",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/tables"), help="default runs/tables")


def carry_over(commands) -> None:
    """Add `tflane carry-over`."""
    parser = command(
        commands,
        "carry-over",
        "train on the maps of some recorded logs, test on the recordings of others: each log is left out once",
        module="carry_over",
        function="run",
    )
    parser.add_argument("maps", metavar="FOLDER", type=Path, help="logs of Argoverse 2 or scenes of nuScenes")
    parser.add_argument("--logs", metavar="LOG", nargs="+", default=[], help="logs to leave out (default: all)")
    parser.add_argument(
        "--models",
        metavar="NAME",
        nargs="+",
        default=[],
        help="models to train, of: generated, 'generated, right-hand traffic', 'generated on city', maps, mixed, "
        "'mixed + BEV', 'generated without traffic', 'mixed without traffic' (default: all)",
    )
    parser.add_argument("--seeds", metavar="N", type=int, default=1, help="number of seeds (default 1)")
    parser.add_argument("--steps", metavar="N", type=int, help="updates of each run (default: the configuration's)")
    parser.add_argument("--scenes", metavar="N", type=int, help="training scenes (default: the configuration's)")
    parser.add_argument(
        "--folds", metavar="N", type=int, help="leave the logs out in N groups (default: each log alone)"
    )
    parser.add_argument("--jobs", type=int, default=1, help="number of trainings at a time (default 1)")
    parser.add_argument(
        "--cores", metavar="N", type=int, help="cores of each training (default: all, shared between --jobs)"
    )
    parser.add_argument("--quick", action="store_true", help="a few updates on a few scenes: a smoke test, no result")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("runs/carry_over"), help="default runs/carry_over"
    )


def sweep(commands) -> None:
    """Add `tflane sweep`."""
    parser = command(
        commands,
        "sweep",
        "evaluate trained models over values of a setting of their test data",
        module="sweep",
        function="run",
        epilog=OVERRIDES,
    )
    parser.add_argument(
        "runs",
        metavar="[NAME=]FOLDER",
        nargs="+",
        help="run folders, or folders with one run per seed, as written by compare",
    )
    parser.add_argument("--setting", required=True, help="dotted name, such as data.world.severity")
    parser.add_argument("--values", nargs="+", required=True, help="values of the setting")
    parser.add_argument(
        "--metrics", nargs="+", help="scores to show, such as all/DET_l gap/recall (default: those of compare)"
    )
    chosen = "default last; `eval` and `predict`: best"
    parser.add_argument("--checkpoint", choices=("last", "best"), default="last", help=chosen)
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/sweep"), help="default runs/sweep")
    parser.set_defaults(takes_overrides=True)


def score(commands) -> None:
    """Add `tflane score`."""
    parser = command(
        commands,
        "score",
        "score a file of predictions, of any framework, by an official protocol",
        module="score",
        function="run",
        epilog=_FILES,
    )
    parser.add_argument("protocol", metavar="PROTOCOL", help="see below")
    parser.add_argument("predictions", metavar="PREDICTIONS", type=Path, help="file of predictions")
    parser.add_argument("truth", metavar="GROUND_TRUTH", type=Path, help="file or folder of annotations")
    parser.add_argument(
        "--by",
        choices=("scene", "distance", "occlusion"),
        help="also report parts of the data; distance and occlusion are for centerlines, lane segments and vector maps",
    )
    parser.add_argument(
        "--bootstrap",
        type=int,
        metavar="N",
        default=0,
        help="95 percent intervals from N bootstrap samples of scenes (about 200 are enough)",
    )
    parser.add_argument(
        "--scenes",
        metavar="FILE",
        type=Path,
        help='scene of each frame, {"frame": "scene"} or nuScenes\' sample.json, for files that do not name it',
    )
    parser.add_argument(
        "--out", metavar="STEM", type=stem, default=Path("score"), help="write STEM.md and STEM.json (default score)"
    )


def demo(commands) -> None:
    """Add `tflane demo`."""
    parser = command(
        commands,
        "demo",
        "train with and without traffic flow, evaluate both, in under ten minutes",
        module="demo",
        function="run",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/demo"), help="default runs/demo")


def bench(commands) -> None:
    """Add `tflane bench`."""
    parser = command(commands, "bench", "run the benchmarks of a source checkout", module="bench", function="run")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/bench"), help="default runs/bench")
