"""Arguments of `tflane markers`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tflane_jax.commands.arguments.shared import command

_CORNERS = ("pattern", "subpixel", "none")


def markers(commands) -> None:
    """Add `tflane markers`."""
    parser = commands.add_parser(
        "markers",
        help="detect fiducial markers, follow drives, write stores of their lanes",
        description="Fiducial markers.",
    )
    inner = parser.add_subparsers(dest="what", required=True, metavar="COMMAND")
    for add in (_store, _run, _render, _detect, _curves):
        add(inner)


def _store(inner) -> None:
    store = command(
        inner, "store", "write the lanes around the markers of a log", module="marker_store", function="run"
    )
    store.add_argument(
        "--log",
        metavar="SCENE|FOLDER",
        required=True,
        help="number of a scene of the built-in world, or an Argoverse 2 log, which gets virtual markers",
    )
    store.add_argument("--out", metavar="FILE", type=Path, default=Path("store.json"), help="default store.json")
    store.add_argument(
        "--radius", type=float, default=50.0, help="largest distance of lanes from their marker, metres (default 50)"
    )
    store.add_argument(
        "--frame",
        choices=("marker", "survey"),
        default="marker",
        help="coordinate frame of the lanes in the file: marker or map (default marker)",
    )
    store.add_argument("--bike-lanes", choices=("include", "exclude"), default="include", help="default include")
    store.add_argument("--surveyed", metavar="YYYY-MM-DD", help="day of the survey")
    store.add_argument("--expires", metavar="YYYY-MM-DD", help="first day on which the entries are invalid")


def _run(inner) -> None:
    run = command(
        inner, "run", "follow a drive: markers, their lanes, and a model's lanes", module="marker_run", function="run"
    )
    run.add_argument("--store", metavar="FILE", type=Path, required=True, help="store of the markers' lanes")
    run.add_argument("--images", metavar="DIR", type=Path, required=True, help="folder of the images, at native size")
    run.add_argument(
        "--poses", metavar="FILE", type=Path, required=True, help="cameras, times and poses (docs/markers.md)"
    )
    run.add_argument("--model", metavar="RUN", type=Path, help="run folder of a model with cameras; default none")
    run.add_argument(
        "--today", metavar="YYYY-MM-DD", help="day for which entries must be valid (default the present day)"
    )
    run.add_argument(
        "--max-age-days", metavar="DAYS", type=int, help="leave out entries surveyed longer ago; default any age"
    )
    run.add_argument(
        "--interval",
        metavar="SECONDS",
        type=float,
        help="take frames this far apart, as in training (default every frame)",
    )
    run.add_argument(
        "--search", choices=("all", "outlines"), default="all", help="all also finds partly hidden boards (default)"
    )
    run.add_argument("--family", default="ARUCO_5X5_100", help="marker family (default ARUCO_5X5_100)")
    run.add_argument(
        "--threshold", type=float, default=0.3, help="lowest score of a lane that is drawn and written (default 0.3)"
    )
    run.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/drive"), help="default runs/drive")


def _render(inner) -> None:
    render = command(
        inner, "render", "write a drive of the built-in world with its store", module="marker_render", function="render"
    )
    render.add_argument("--log", metavar="SCENE", type=int, required=True, help="number of the scene")
    render.add_argument("--frames", type=int, default=8, help="frames, half a second apart (default 8)")
    render.add_argument("--ring", choices=("argoverse2", "nuscenes"), default="argoverse2", help="default argoverse2")
    render.add_argument("--cameras", type=int, default=3, help="first cameras of the ring (default 3)")
    render.add_argument("--scale", type=float, default=1.0, help="size of the images, 1 is native (default 1)")
    render.add_argument("--surveyed", metavar="YYYY-MM-DD", help="day of the survey, for the store; default none")
    render.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to write")


def _detect(inner) -> None:
    detect = command(
        inner, "detect", "detect markers in photos of a calibrated camera", module="markers", function="find"
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
        help="lens distortion, OpenCV's K1 K2 P1 P2 [K3 [K4 K5 K6]]; default none",
    )
    detect.add_argument("--size", type=float, default=1.0, help="side of the black square, metres (default 1)")
    detect.add_argument(
        "--height", type=float, default=1.5, help="height of the camera above ground, metres (default 1.5)"
    )
    detect.add_argument("--pitch", type=float, default=0.0, help="downward pitch of the camera, degrees (default 0)")
    detect.add_argument("--out", metavar="DIR", type=Path, default=Path("runs/markers"), help="default runs/markers")
    detect.add_argument(
        "--search",
        choices=("outlines", "all"),
        default="outlines",
        help="all also finds partly hidden boards, more slowly (default outlines)",
    )
    _detector(detect)
    detect.add_argument("--corners", choices=_CORNERS, default="pattern", help="corner refinement (default pattern)")


def _curves(inner) -> None:
    curves = command(
        inner,
        "curves",
        "measure detection rate and pose error over distance, in the built-in world",
        module="markers",
        function="curves",
    )
    curves.add_argument(
        "--distances",
        type=float,
        nargs="+",
        default=[5.0 * n for n in range(1, 13)],
        help="distances, metres (default 5 to 60)",
    )
    curves.add_argument(
        "--scales",
        type=float,
        nargs="+",
        default=[1.0, 0.5],
        help="image sizes as fractions of the native size (default 1 0.5)",
    )
    curves.add_argument("--seeds", type=int, default=8, help="scenes, with three boards each (default 8)")
    curves.add_argument(
        "--severity", type=float, default=0.5, help="severity of weather and camera, 0 to 1 (default 0.5)"
    )
    curves.add_argument(
        "--sigma-d",
        type=float,
        default=40.0,
        help="sigma_d of the paper's detection curve in the picture, metres (default 40)",
    )
    curves.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to write")
    _detector(curves)
    curves.add_argument(
        "--corners",
        choices=_CORNERS,
        nargs="+",
        default=["pattern", "subpixel"],
        help="corner refinement (default pattern subpixel)",
    )


def _detector(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--family", default="ARUCO_5X5_100", help="marker family (default ARUCO_5X5_100)")
    parser.add_argument(
        "--enlarge", type=int, default=1, help="factor by which images are enlarged before detection (default 1)"
    )
