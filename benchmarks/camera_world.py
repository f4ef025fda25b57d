"""Time to render the camera images of the built-in world.

    python -m benchmarks.camera_world --out runs/bench

One process on one core. CPU time, because wall time depends on the load of the machine. Ground, scenery and sky of a
scene are drawn once for all its key frames, so a frame costs its images and a fraction of that.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.timing import command_line, machine, markdown_table, save
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING, CameraRigConfig
from tflane_jax.world.cameras.sensor import render_cameras
from tflane_jax.world.simulate import WorldConfig, simulate


class Rig(NamedTuple):
    """A ring of cameras to time, and how many scenes are enough."""

    name: str
    config: CameraRigConfig
    scenes: int


RIGS = (
    Rig("6 x 160x96", CameraRigConfig(NUSCENES_RING, scale=0.1, multiple=32), 12),
    Rig("7 x 160x128", CameraRigConfig(ARGOVERSE2_RING, scale=0.078, multiple=32), 12),
    Rig("6 x 224x128", CameraRigConfig(NUSCENES_RING, scale=0.14, multiple=32), 12),
    Rig("7 x 1024x775", CameraRigConfig(ARGOVERSE2_RING, scale=0.5), 2),
    Rig("6 x 1600x900", CameraRigConfig(NUSCENES_RING, scale=1.0), 2),
    Rig("7 x 2048x1550", CameraRigConfig(ARGOVERSE2_RING, scale=1.0), 2),
)


def run(out: Path, first: int = 0) -> dict[str, Any]:
    """Measure everything, print the table, write `camera_world.json` and `camera_world.md` into `out`, and return the
    record.

    Args:
        out: folder.
        first: number of the first scene.
    """
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    world = WorldConfig()
    results = []
    try:
        for rig in RIGS:
            logs = [simulate(first + number, world) for number in range(rig.scenes)]
            # The first images also pay for imports and for tables that all scenes share.
            render_cameras(logs[0], 0, rig.config)
            opening = [_seconds(log, 0, rig.config) for log in logs[1:]]
            frames = [_seconds(log, k, rig.config) for log in logs[1:] for k in range(1, len(log.keyframes))]
            frame, scene = float(np.median(frames)), float(np.median(opening) - np.median(frames))
            results.append(
                {
                    "rig": rig.name,
                    "ms_frame": 1e3 * frame,
                    "ms_image": 1e3 * frame / len(rig.config.cameras),
                    "ms_scene": 1e3 * scene,
                    "ms_frame_of_dataset": 1e3 * (frame + scene / world.keyframes),
                }
            )
    finally:
        cv2.setNumThreads(threads)
    table = markdown_table(
        ["cameras", "ms an image", "ms a frame", "ms a scene", "ms a frame of a data set"],
        [
            [r["rig"], *(f"{r[key]:.0f}" for key in ("ms_image", "ms_frame", "ms_scene", "ms_frame_of_dataset"))]
            for r in results
        ],
    )
    table += f"\n\nCPU time, one core; a data set has {world.keyframes} frames a scene. Medians over frames and scenes."
    print(table)
    record = {"machine": machine(), "results": results}
    save(out, "camera_world", record, table)
    return record


def _seconds(log: Any, keyframe: int, config: CameraRigConfig) -> float:
    start = time.process_time()
    render_cameras(log, keyframe, config)
    return time.process_time() - start


def main() -> None:
    """Parse the command line and run."""
    parser = command_line(__doc__)
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    options = parser.parse_args()
    run(options.out, options.first)


if __name__ == "__main__":
    main()
