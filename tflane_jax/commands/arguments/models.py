"""Arguments of the commands for one model: train, eval, predict, convert, export, summary."""

from __future__ import annotations

from pathlib import Path

from tflane_jax.commands.arguments.shared import (
    OVERRIDES,
    command,
    example_arguments,
    model_arguments,
    split_arguments,
    stem,
)

_PREDICT = """Lane lines in photos and videos of any size:
  tflane predict RUN photo.jpg drive.mp4 folder/                     with a model trained by tflane
  tflane predict --config gtn_lane/lstr --weights lstr photo.jpg     with the published weights (docs/gtn_lane.md)
The part of a photo that suits the model is searched, unless --focal and --horizon describe the camera."""


def train(commands) -> None:
    """Add `tflane train`."""
    # The command prints its help itself, because with --config the help lists that configuration's settings.
    parser = command(
        commands, "train", "train a model", module="train", function="run", epilog=OVERRIDES, add_help=False
    )
    parser.add_argument(
        "--config",
        metavar="FILE[:NAME]",
        help="config file: path, or name such as tf_lane/toponet; NAME of an ablation",
    )
    parser.add_argument("--out", metavar="RUN", type=Path, help="run folder (default runs/<name of the config file>)")
    start = parser.add_mutually_exclusive_group()
    start.add_argument(
        "--resume",
        action="store_const",
        const="resume",
        dest="start",
        help="continue the run in --out with its own configuration (without --config)",
    )
    start.add_argument(
        "--overwrite", action="store_const", const="overwrite", dest="start", help="delete the run in --out first"
    )
    several = parser.add_argument_group("one training by several processes (docs/scale.md)")
    several.add_argument(
        "--distributed", action="store_true", help="join the processes that the cluster started: Slurm, Open MPI, ..."
    )
    several.add_argument("--coordinator", metavar="HOST:PORT", help="address of process 0, without a cluster")
    several.add_argument("--processes", type=int, metavar="N", help="number of processes")
    several.add_argument("--process", type=int, metavar="I", help="number of this one, from 0")
    parser.add_argument("-h", "--help", action="store_true", dest="wants_help", help="show this and exit")
    parser.set_defaults(start="new", takes_overrides=True, usage=parser.format_help())


def evaluate(commands) -> None:
    """Add `tflane eval`."""
    parser = command(commands, "eval", "evaluate a trained run", module="evaluate", function="run")
    model_arguments(parser)
    example_arguments(parser, "test")
    parser.add_argument(
        "--traffic",
        choices=("own", "none", "other-scene"),
        help="traffic flow that the model sees: of the frame, none, or of another scene (default: the configuration's)",
    )
    parser.add_argument(
        "--topology",
        choices=("learned", "geometric"),
        help="connections of lanes: as predicted, or with TopoLogic's score of end and start points added "
        "(default: the configuration's)",
    )
    parser.add_argument(
        "--versions",
        nargs="+",
        choices=("v2.1", "v1.0"),
        help="versions of OpenLane-V2's metrics of centerlines; the second one adds columns (default: the "
        "configuration's)",
    )
    parser.add_argument(
        "--map-measures",
        nargs="+",
        choices=("chamfer", "iou"),
        help="of the lines of a vector map: MapTR's AP by distance, and by overlap (default: the configuration's)",
    )
    parser.add_argument(
        "--errors",
        action="store_true",
        help="also count lanes found with a wrong extent, in part, or not at all, and the same of detections",
    )
    parser.add_argument(
        "--training-root",
        metavar="DIR",
        type=Path,
        help="folder of the data set whose training split the model learned, for the groups near and far from training "
        "(default: the configuration's)",
    )
    parser.add_argument(
        "--out", metavar="STEM", type=stem, help="write STEM.md and STEM.json (default RUN/evaluations/<split>...)"
    )


def predict(commands) -> None:
    """Add `tflane predict`."""
    parser = command(
        commands, "predict", "write predictions and pictures", module="predict", function="run", epilog=_PREDICT
    )
    model_arguments(parser, "run folder; then photos, videos or folders of them, for models of lane lines in one image")
    example_arguments(parser, "val")
    parser.add_argument(
        "--count",
        type=int,
        help="number of examples, spread evenly over the split (default 8; more than there are: all); at most 16 are "
        "drawn",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        help="lowest score of a lane in JSON and pictures (default 0.3; of lane lines in one image 0.5, as LSTR)",
    )
    parser.add_argument(
        "--cameras",
        action="store_true",
        help="also draw predictions into rendered camera images, for a model that reads no images (built-in world)",
    )
    parser.add_argument("--focal", type=float, metavar="PIXELS", help="focal length of the photos' camera")
    parser.add_argument("--horizon", type=float, metavar="ROW", help="row of the horizon in the photos, pixels")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("runs/predict"), help="folder to write (default runs/predict)"
    )


def submit(commands) -> None:
    """Add `tflane submit`."""
    parser = command(
        commands,
        "submit",
        "write OpenLane-V2's submission for a whole split, or MapTR's file for nuScenes",
        module="submit",
        function="run",
    )
    model_arguments(parser)
    split_arguments(parser, "test", ", the official one; for nuScenes, what the configuration tests on")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, required=True, help="a pickle, or MapTR's nuscmap_results.json"
    )
    for name, what in (("lanes", "lanes"), ("elements", "traffic elements")):
        parser.add_argument(
            f"--most-{name}",
            type=int,
            metavar="N",
            help=f"OpenLane-V2: only the N {what} of the highest scores in each frame, for a smaller file",
        )
    about = parser.add_argument_group("what OpenLane-V2's server asks for; not needed to score the file yourself")
    about.add_argument("--method", default="", help="name of the method")
    about.add_argument("--authors", nargs="+", default=[], metavar="NAME", help="names of the authors")
    about.add_argument("--email", default="", help="address of the submitter")
    about.add_argument("--institution", default="", help="institution or company")
    about.add_argument("--country", default="", help="country or region, as in ISO 3166")
    about.add_argument("--team", default="", help="name of the team; for lane segments")


def convert(commands) -> None:
    """Add `tflane convert`."""
    parser = command(
        commands, "convert", "turn published PyTorch weights into a run folder", module="convert", function="run"
    )
    parser.add_argument("--config", metavar="FILE[:NAME]", required=True, help="config file of the same model")
    parser.add_argument(
        "--weights",
        metavar="FILE",
        type=Path,
        help="checkpoint, .pth, .pkl or .npz (default: that of the config)",
    )
    parser.add_argument(
        "--entry",
        metavar="NAME",
        help="where the weights are in the checkpoint, such as state_dict_ema (default: where they usually are)",
    )
    parser.add_argument(
        "--edge-weight",
        metavar="FRACTION",
        type=float,
        help="LSTR's weights in a GTN encoder: weight of the edge types that make it LSTR's encoder (default 1, "
        "exactly; 0.98 lets fine-tuning change the selection)",
    )
    parser.add_argument("--out", metavar="RUN", type=Path, required=True, help="run folder to write")


def export(commands) -> None:
    """Add `tflane export`."""
    parser = command(
        commands,
        "export",
        "write a model with its weights as one StableHLO program",
        module="export",
        function="run",
    )
    model_arguments(parser)
    split_arguments(parser, "val", "; a model of lanes around the vehicle is checked with its first frame")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, default=Path("model.stablehlo"), help="default model.stablehlo"
    )


def summary(commands) -> None:
    """Add `tflane summary`."""
    parser = command(
        commands,
        "summary",
        "count a model's parameters, operations and memory",
        module="summary",
        function="run",
        epilog=OVERRIDES,
    )
    parser.add_argument("--config", metavar="FILE[:NAME]", help="config file (default: the default configuration)")
    parser.add_argument("--depth", type=int, help="levels of parameter names in the table (default 1)")
    parser.add_argument(
        "--no-compile", action="store_true", help="count operations only: up to a minute or two at the papers' sizes"
    )
    parser.add_argument("--no-training", action="store_true", help="omit the training step")
    parser.add_argument(
        "--plan", metavar="DEVICES", type=int, help="estimate memory and time of the training on so many accelerators"
    )
    kinds = ["a100", "h100", "h200", "rtx3090", "rtx4090"]  # of plan.ACCELERATORS
    parser.add_argument("--kind", choices=kinds, help="with --plan: kind of the accelerators (default h100)")
    parser.add_argument(
        "--utilisation", type=float, help="with --plan: fraction of the peak that is assumed (default 0.04)"
    )
    parser.add_argument("--out", metavar="STEM", type=stem, help="write STEM.md and STEM.json")
    parser.set_defaults(takes_overrides=True)
