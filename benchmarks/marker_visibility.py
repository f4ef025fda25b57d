"""Which boards a vehicle sees, by how they are placed and by what hides them.

    python -m benchmarks.marker_visibility --scenes 40

Scenes of the test split with boards on both sides of junctions, eight key frames half a second apart, no noise. "field
of view" is the simulation that knows neither the upper edge of an image nor masts, signs, lamp posts and trees.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np

from benchmarks.timing import markdown_table
from tflane_jax.datasets.procedural import FIRST_SCENE
from tflane_jax.markers.simulation import PERFECT, simulate_detections
from tflane_jax.scene.logs import KeyFrame, Log
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.simulate import WorldConfig, simulate

SIMULATIONS = {
    "field of view": PERFECT,
    "Argoverse 2": replace(PERFECT, cameras=ARGOVERSE2_RING, occlusion="bodies"),
    "nuScenes": replace(PERFECT, cameras=NUSCENES_RING, occlusion="bodies"),
}
_BANDS = ((0.0, 8.0), (8.0, 25.0), (25.0, 60.0))


def moments(site: Literal["junction", "clear"], scenes: int) -> Iterator[tuple[Log, KeyFrame]]:
    """Yield every key frame of the scenes."""
    world = WorldConfig(duration_s=5.6, keyframes=8, markers=PlacementConfig(side="both", site=site))
    for scene in range(scenes):
        log = simulate(FIRST_SCENE["test"] + scene, world)
        for moment in log.keyframes:
            yield log, moment


def measure(site: Literal["junction", "clear"], scenes: int) -> list[list[str]]:
    """Return a row for each simulation: frames that see a board, and of those in the field of view, how many."""
    frames, seeing = 0, dict.fromkeys(SIMULATIONS, 0)
    boards = {name: np.zeros(len(_BANDS), int) for name in SIMULATIONS}
    for log, moment in moments(site, scenes):
        frames += 1
        assert log.markers is not None
        for name, config in SIMULATIONS.items():
            found = simulate_detections(log, moment, log.markers, config)
            seeing[name] += bool(found.valid.any())
            distance = np.hypot(*found.pose[found.valid][:, :2, 3].T)
            boards[name] += [int(((distance >= low) & (distance < high)).sum()) for low, high in _BANDS]
    return [[site, name, f"{seeing[name] / frames:.1%}", *map(str, boards[name].tolist())] for name in SIMULATIONS]


def main() -> None:
    """Parse the command line, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=40)
    scenes = parser.parse_args().scenes
    bands = [f"boards at {low:g} to {high:g} m" for low, high in _BANDS]
    rows = measure("junction", scenes) + measure("clear", scenes)
    print(markdown_table(["site", "visible", "frames that see one", *bands], rows))


if __name__ == "__main__":
    main()
