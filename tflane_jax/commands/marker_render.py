"""`tflane markers render`: a drive of the built-in world as `tflane markers run` reads it, with its store."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tflane_jax.commands.marker_store import day_of
from tflane_jax.datasets.drive_files import Drive, DriveCamera, DriveFrame, save_drive
from tflane_jax.datasets.marker_observations import store_of_log
from tflane_jax.errors import UserError
from tflane_jax.files.atomic import check_folder, replacing, write_bytes
from tflane_jax.files.images import opencv
from tflane_jax.geometry import invert_pose
from tflane_jax.limits import check_settings
from tflane_jax.markers.store import MarkerStore
from tflane_jax.markers.store_files import save_store
from tflane_jax.progress import progress_bar
from tflane_jax.scene.logs import Log
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING, CameraRigConfig, draw_rig
from tflane_jax.world.cameras.sensor import render_cameras
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.simulate import WorldConfig, simulate

_MOST_FRAMES = 7000  # an hour
_RINGS = {"argoverse2": ARGOVERSE2_RING, "nuscenes": NUSCENES_RING}


def render(options: argparse.Namespace) -> int:
    """Write a drive of the built-in world: images, poses.json and store.json."""
    if not 1 <= options.frames <= _MOST_FRAMES or not options.scale > 0.0:
        raise UserError(f"--frames must be from 1 to {_MOST_FRAMES} and --scale positive")
    surveyed = day_of(options.surveyed, "--surveyed")
    if options.log < 0:
        raise UserError(f"--log is the number of a scene, 0 or more, not {options.log}")
    ring = _RINGS[options.ring]
    if not 1 <= options.cameras <= len(ring):
        raise UserError(f"--cameras is 1 to {len(ring)}, the cameras of --ring {options.ring}, not {options.cameras}")
    boards = PlacementConfig(side="both", site="clear")
    rig = CameraRigConfig(cameras=ring[: options.cameras], scale=options.scale, markers=True)
    check_settings(rig, "--")
    check_folder(options.out)
    opencv()  # before anything is simulated
    if options.out.is_dir() and any(options.out.iterdir()):
        raise UserError(f"{options.out} is not empty: choose another folder (--out), images of two drives would mix")
    # Two seconds of history come before the first frame.
    world = WorldConfig(duration_s=1.6 + 0.5 * options.frames, keyframes=options.frames, markers=boards)
    log = simulate(options.log, world)
    store = store_of_log(log, radius=50.0, bike_lanes=True, surveyed=surveyed)
    if not store.markers:
        raise UserError(f"{log.name} has no junction, split or merge, and so no marker: take another --log")
    with replacing(options.out) as folder:
        _render(log, rig, store, folder)
    print(
        f"{options.frames} frames of {options.cameras} cameras written to {options.out}: images/, poses.json, "
        "store.json"
    )
    return 0


def _render(log: Log, rig: CameraRigConfig, store: MarkerStore, folder: Path) -> None:
    """Write images, poses and store of a drive."""
    cv2, images, frames = opencv(), folder / "images", []
    sizes: dict[str, tuple[int, int]] = {}
    images.mkdir(parents=True)
    for number, moment in enumerate(progress_bar(log.keyframes, desc="render", unit="frame")):
        views, files = render_cameras(log, number, rig), {}
        for place, mount in enumerate(rig.cameras):
            sizes[mount.name] = width, height = views.size[place].tolist()
            files[mount.name] = images / f"{number:03d}-{mount.name}.png"
            picture = np.asarray(views.image)[place, :height, :width, ::-1]
            write_bytes(files[mount.name], cv2.imencode(".png", picture)[1].tobytes())
        frames.append(DriveFrame(moment.timestamp_ns, moment.global_from_ego, files))
    cameras = tuple(
        DriveCamera(mount.name, camera.intrinsics, invert_pose(camera.camera_from_ego), size=sizes[mount.name])
        for mount, camera in zip(rig.cameras, draw_rig(log.seed, rig), strict=True)
    )
    save_drive(Drive(cameras, tuple(frames)), folder / "poses.json", images)
    save_store(store, folder / "store.json")
