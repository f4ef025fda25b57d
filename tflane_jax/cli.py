"""`tflane`, the command line: what each command takes. What it does is in `tflane_jax.commands`, imported when needed.

Nothing slow is imported here, so that `tflane --help` is instant.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from tflane_jax.errors import UserError

_OVERRIDES = """Any setting of the configuration can be changed by its dotted name, say --optim.lr 1e-3.
`tflane train --config FILE --help` lists them all with their values."""

_FILES = """Protocols and their files:
  openlane-v2.1-centerline, openlane-v1.0-centerline
      PREDICTIONS is the pickle of an OpenLane-V2 submission; GROUND_TRUTH the devkit's collected pickle, or the
      dataset's folder with SPLIT/SEGMENT/info/TIMESTAMP.json. The versions differ in TOP_ll and TOP_lt, by a factor
      of about four: say which one you report. v2.1 is also that of devkit v1.1. Both sides may also be plain .npz or
      .json files (docs/scoring.md), such as `tflane predict` writes; without traffic elements.
  openlane-v2.1-lane-segment, lanesegnet
      The same files of the lane-segment task (TIMESTAMP-ls.json). The first gives the devkit's OLUS, the second the
      mAP of the LaneSegNet and TF-Lane papers.
  openlane-v2-f-score
      The files of the centerline protocols; the devkit's F-score of 3-D lanes.
  maptr, maptrv2
      MapTR's nuscmap_results.json and the *_map_anns_val.json that its evaluation writes.
  tusimple, tusimple-lstr
      Both files hold one JSON record a line: raw_file, lanes (x at every row, negative where there is none), h_samples
      (the truth) or run_time in ms (predictions). tusimple-lstr allows 20 s an image instead of 200 ms, like LSTR."""

_PREDICT = """Lane lines in photos of any size:
  tflane predict RUN photo.jpg folder/          with a model that was trained here
  tflane predict --config FILE photo.jpg        with the published weights that the config file names
Photos of another camera than TuSimple's are cut to its field of view where --focal and --horizon say how."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 2 an error of the user's, 128 + n ended by signal n."""
    parser = build_parser()
    options, rest = parser.parse_known_args(arguments)
    if rest and not options.takes_overrides:
        parser.error(f"unknown argument {rest[0]}: see tflane {options.command} --help")
    try:
        command = getattr(importlib.import_module(f"tflane_jax.commands.{options.module}"), options.function)
        return (command(options, rest) if options.takes_overrides else command(options)) or 0
    except UserError as error:
        print(f"tflane: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("tflane: stopped", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:  # `tflane ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(prog="tflane", description="Lane perception with priors, in JAX.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _train(commands)
    _evaluate(commands)
    _predict(commands)
    _convert(commands)
    _export(commands)
    _data(commands)
    _summary(commands)
    _compare(commands)
    _sweep(commands)
    _score(commands)
    _markers(commands)
    _demo(commands)
    _bench(commands)
    return parser


def _command(commands, name: str, text: str, *, function: str, module: str, epilog: str = "", **more):
    parser = commands.add_parser(
        name,
        help=text,
        description=text[0].upper() + text[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **more,
    )
    parser.set_defaults(module=module, function=function, takes_overrides=False)
    return parser


def _train(commands) -> None:
    # Its help is printed by the command itself, because with a config it lists that config's settings.
    parser = _command(
        commands, "train", "train a model", module="train", function="run", epilog=_OVERRIDES, add_help=False
    )
    parser.add_argument("--config", metavar="FILE[:NAME]", help="config file (.py), or one of its ablations")
    parser.add_argument("--out", metavar="RUN", type=Path, help="run folder (default runs/<name of the config file>)")
    start = parser.add_mutually_exclusive_group()
    start.add_argument(
        "--resume",
        action="store_const",
        const="resume",
        dest="start",
        help="go on with the run in --out (its own configuration, --config not needed)",
    )
    start.add_argument(
        "--overwrite", action="store_const", const="overwrite", dest="start", help="delete the run in --out first"
    )
    parser.add_argument("-h", "--help", action="store_true", dest="wants_help", help="show this and exit")
    parser.set_defaults(start="new", takes_overrides=True, usage=parser.format_help())


def _checkpoint(text: str) -> int | str:
    if text in ("best", "last"):
        return text
    if text.isdecimal():
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is neither best, last nor a step")


def _model_arguments(parser: argparse.ArgumentParser, inputs: str = "run folder") -> None:
    parser.add_argument("inputs", metavar="RUN", nargs="*", type=Path, help=inputs)
    parser.add_argument(
        "--config", metavar="FILE[:NAME]", help="instead of a run: a config file that names published weights"
    )
    parser.add_argument(
        "--checkpoint",
        metavar="best|last|STEP",
        type=_checkpoint,
        help="default best, or last where nothing was evaluated",
    )


def _example_arguments(parser: argparse.ArgumentParser, split: str) -> None:
    _split_arguments(parser, split)
    parser.add_argument("--max-instances", type=int, metavar="N", help="use at most N road users; 0 is no traffic flow")


def _split_arguments(parser: argparse.ArgumentParser, split: str) -> None:
    parser.add_argument("--split", choices=("train", "val", "test"), default=split, help=f"default {split}")
    _source_arguments(parser)


def _source_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data",
        choices=("procedural", "world-cameras", "argoverse2", "openlane-v2", "front-views", "tusimple"),
        help="take other data than the configuration's",
    )
    parser.add_argument(
        "--root", metavar="PATH", help="folder of --data argoverse2 (a log, or logs), openlane-v2 or tusimple"
    )
    parser.add_argument("--openlane", metavar="PATH", help="folder of the OpenLane-V2 split files, if there is one")


def _evaluate(commands) -> None:
    parser = _command(commands, "eval", "evaluate a trained run", module="evaluate", function="run")
    _model_arguments(parser)
    _example_arguments(parser, "test")
    parser.add_argument(
        "--out", metavar="STEM", type=Path, help="write STEM.md and STEM.json (default RUN/evaluations/<split>...)"
    )


def _predict(commands) -> None:
    parser = _command(
        commands, "predict", "write predictions and pictures", module="predict", function="run", epilog=_PREDICT
    )
    _model_arguments(parser, "run folder; then photos or folders of photos, for models of lane lines in one image")
    _example_arguments(parser, "val")
    parser.add_argument("--count", type=int, default=8, help="examples, spread evenly over the split (default 8)")
    parser.add_argument(
        "--threshold", type=float, default=0.3, help="least score of a lane in JSON and pictures (default 0.3)"
    )
    parser.add_argument("--focal", type=float, metavar="PIXELS", help="focal length of the photos' camera")
    parser.add_argument("--horizon", type=float, metavar="ROW", help="row of the horizon in the photos, pixels")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("runs/predict"), help="where to write (default runs/predict)"
    )


def _export(commands) -> None:
    parser = _command(
        commands,
        "export",
        "write a model of lane lines in one image as a StableHLO program",
        module="export",
        function="run",
    )
    _model_arguments(parser)
    parser.add_argument(
        "--out", metavar="FILE", type=Path, default=Path("model.stablehlo"), help="default model.stablehlo"
    )


def _convert(commands) -> None:
    parser = _command(
        commands, "convert", "turn published PyTorch weights into a run folder", module="convert", function="run"
    )
    parser.add_argument("--config", metavar="FILE[:NAME]", required=True, help="config file of the same model")
    parser.add_argument(
        "--weights",
        metavar="FILE",
        type=Path,
        help="checkpoint, .pth, .pkl or .npz (default: the one that the config names)",
    )
    parser.add_argument("--out", metavar="RUN", type=Path, required=True, help="run folder to write")


def _data(commands) -> None:
    parser = commands.add_parser("data", help="look at datasets", description="Look at datasets.")
    inner = parser.add_subparsers(dest="what", required=True, metavar="COMMAND")
    show = _command(inner, "show", "draw samples of a dataset and count what is in it", module="data", function="show")
    show.add_argument("--config", metavar="FILE", help="config file whose data to show (default: the built-in world)")
    _split_arguments(show, "train")
    show.add_argument("--count", type=int, default=8, help="examples (default 8)")
    show.add_argument(
        "--out", metavar="FILE", type=Path, default=Path("samples.png"), help="picture (default samples.png)"
    )
    check = _command(inner, "check", "say what a dataset's folder lacks", module="data", function="check")
    check.add_argument("root", metavar="PATH", help="a log, a folder of logs, or OpenLane-V2's folder")
    check.add_argument(
        "--format",
        choices=("argoverse2", "openlane-v2"),
        default="argoverse2",
        help="of the dataset (default argoverse2)",
    )
    export = _command(
        inner,
        "export",
        "write a dataset with cameras in another format",
        module="data_export",
        function="run",
        epilog=_OVERRIDES,
    )
    export.add_argument("--format", choices=("openlane-v2",), default="openlane-v2", help="default openlane-v2")
    export.add_argument("--config", metavar="FILE[:NAME]", help="config file whose data to write", required=True)
    _source_arguments(export)
    export.add_argument(
        "--splits", choices=("train", "val", "test"), nargs="+", default=["train", "val"], help="default train val"
    )
    export.add_argument("--images", choices=("jpg", "png"), default="jpg", help="jpg as official, png without loss")
    export.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to write")
    export.set_defaults(takes_overrides=True)
    overlap = _command(
        inner, "overlap", "say whether two splits show the same places", module="data", function="overlap_of_splits"
    )
    overlap.add_argument(
        "train", metavar="TRAIN", type=Path, help="folder of Argoverse 2 logs, or of OpenLane-V2 segments"
    )
    overlap.add_argument("validation", metavar="VALIDATION", type=Path, help="the same of the other split")
    overlap.add_argument("--out", metavar="STEM", type=Path, help="write STEM.md and STEM.json")
    build = _command(
        inner,
        "build",
        "make the built-in world's examples ahead of training",
        module="data",
        function="build",
        epilog=_OVERRIDES,
    )
    build.add_argument("--config", metavar="FILE[:NAME]", help="config file (default: the built-in world)")
    build.set_defaults(takes_overrides=True)


def _summary(commands) -> None:
    parser = _command(
        commands,
        "summary",
        "count a model's parameters, operations and memory",
        module="summary",
        function="run",
        epilog=_OVERRIDES,
    )
    parser.add_argument("--config", metavar="FILE[:NAME]", help="config file (default: the default configuration)")
    parser.add_argument("--depth", type=int, default=1, help="levels of parameter names (default 1)")
    parser.add_argument("--no-compile", action="store_true", help="count operations only, which takes seconds")
    parser.add_argument("--no-training", action="store_true", help="leave the training step out")
    parser.add_argument("--out", metavar="STEM", type=Path, help="write STEM.md and STEM.json")
    parser.set_defaults(takes_overrides=True)


def _compare(commands) -> None:
    parser = _command(
        commands,
        "compare",
        "train configurations with several seeds and test their differences",
        module="compare",
        function="run",
        epilog=_OVERRIDES,
    )
    parser.add_argument(
        "configs",
        metavar="[NAME=]FILE[:ABLATION]",
        nargs="+",
        help="config files; the first one is what the others are compared with",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="default 0 1 2 3 4")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time, sharing the cores (default 1)")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/compare"), help="default runs/compare")
    parser.add_argument(
        "--test",
        metavar="NAME='SETTINGS'",
        action="append",
        default=[],
        help="evaluate on a further test set, say --test rain='--data.world.severity 1'; may be given several times",
    )
    parser.add_argument(
        "--retrain",
        action="store_true",
        help="delete runs of other configurations in --out, and train them anew",
    )
    parser.set_defaults(takes_overrides=True)


def _sweep(commands) -> None:
    parser = _command(
        commands,
        "sweep",
        "evaluate trained models while a setting of their test data changes",
        module="sweep",
        function="run",
        epilog=_OVERRIDES,
    )
    parser.add_argument(
        "runs",
        metavar="[NAME=]FOLDER",
        nargs="+",
        help="run folders, or folders with one for each seed as compare leaves them",
    )
    parser.add_argument("--setting", required=True, help="dotted name, say data.world.severity")
    parser.add_argument("--values", nargs="+", required=True, help="of the setting")
    parser.add_argument("--metrics", nargs="+", help="to show, say all/DET_l gap/recall (default: as compare does)")
    parser.add_argument("--checkpoint", choices=("last", "best"), default="last", help="default last")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/sweep"), help="default runs/sweep")
    parser.set_defaults(takes_overrides=True)


def _score(commands) -> None:
    parser = _command(
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
        help="report parts as well; distance and occlusion: of centerlines",
    )
    parser.add_argument(
        "--bootstrap",
        type=int,
        metavar="N",
        default=0,
        help="95 percent intervals from N draws of whole scenes (some 200 are enough)",
    )
    parser.add_argument(
        "--out", metavar="STEM", type=Path, default=Path("score"), help="write STEM.md and STEM.json (default score)"
    )


def _markers(commands) -> None:
    parser = commands.add_parser(
        "markers", help="find fiducial markers, and store the lanes that they name", description="Fiducial markers."
    )
    inner = parser.add_subparsers(dest="what", required=True, metavar="COMMAND")
    _marker_store(inner)
    detect = _command(
        inner, "detect", "find markers in photos of a calibrated camera", module="markers", function="find"
    )
    detect.add_argument("images", metavar="IMAGES", nargs="+", type=Path, help="photos, or folders of photos")
    detect.add_argument(
        "--intrinsics",
        metavar=("FX", "FY", "CX", "CY"),
        nargs=4,
        type=float,
        required=True,
        help="focal lengths and principal point, pixels from the image's corner",
    )
    detect.add_argument(
        "--distortion",
        metavar="K",
        nargs="+",
        type=float,
        help="of the lens: OpenCV's K1 K2 P1 P2 [K3 [K4 K5 K6]]; default none",
    )
    detect.add_argument("--size", type=float, default=1.0, help="side of the black square, metres (default 1)")
    detect.add_argument("--height", type=float, default=1.5, help="of the camera above ground, metres (default 1.5)")
    detect.add_argument("--pitch", type=float, default=0.0, help="of the camera, downwards, degrees (default 0)")
    detect.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/markers"), help="default runs/markers")
    curves = _command(
        inner,
        "curves",
        "measure how detection and pose get worse with distance, in the built-in world",
        module="markers",
        function="curves",
    )
    curves.add_argument(
        "--distances", type=float, nargs="+", default=[5.0 * n for n in range(1, 13)], help="metres (default 5 to 60)"
    )
    curves.add_argument(
        "--scales", type=float, nargs="+", default=[1.0, 0.5], help="sizes of the images, 1 is native (default 1 0.5)"
    )
    curves.add_argument("--seeds", type=int, default=8, help="scenes, with three boards each (default 8)")
    curves.add_argument("--severity", type=float, default=0.5, help="of weather and camera, 0 to 1 (default 0.5)")
    curves.add_argument(
        "--sigma-d", type=float, default=40.0, help="of the paper's detection curve in the picture, metres (default 40)"
    )
    curves.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to write")
    for command, many in ((detect, False), (curves, True)):
        command.add_argument("--family", default="ARUCO_5X5_100", help="of the markers (default ARUCO_5X5_100)")
        command.add_argument("--enlarge", type=int, default=1, help="search images so many times larger (default 1)")
        ways = ("pattern", "subpixel", "none")
        if many:
            command.add_argument(
                "--corners",
                choices=ways,
                nargs="+",
                default=["pattern", "subpixel"],
                help="how corners are found (default pattern subpixel)",
            )
        else:
            command.add_argument("--corners", choices=ways, default="pattern", help="how corners are found")


def _marker_store(inner) -> None:
    store = _command(
        inner, "store", "write which lanes the markers of a log name", module="marker_store", function="run"
    )
    store.add_argument(
        "--log",
        metavar="SCENE|FOLDER",
        required=True,
        help="number of a world scene, or an Argoverse 2 log, which gets virtual markers",
    )
    store.add_argument("--out", metavar="FILE", type=Path, default=Path("store.json"), help="default store.json")
    store.add_argument("--radius", type=float, default=50.0, help="lanes so near to a marker, metres (default 50)")
    store.add_argument(
        "--frame",
        choices=("marker", "survey"),
        default="marker",
        help="of the lanes in the file: the marker's, or the map's (default marker)",
    )
    store.add_argument("--bike-lanes", choices=("include", "exclude"), default="include", help="default include")
    store.add_argument("--surveyed", metavar="YYYY-MM-DD", help="day of the survey")
    store.add_argument("--expires", metavar="YYYY-MM-DD", help="first day on which the entries count no longer")


def _demo(commands) -> None:
    parser = _command(
        commands,
        "demo",
        "train with and without traffic flow, evaluate both, in under ten minutes",
        module="demo",
        function="run",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/demo"), help="default runs/demo")


def _bench(commands) -> None:
    parser = _command(commands, "bench", "run the benchmarks of a source checkout", module="bench", function="run")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/bench"), help="default runs/bench")


if __name__ == "__main__":
    sys.exit(main())
