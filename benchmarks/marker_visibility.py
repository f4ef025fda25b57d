"""Which boards a vehicle sees, by how they are placed and by what hides them.

    python -m benchmarks.marker_visibility --scenes 40
    python -m benchmarks.marker_visibility --scenes 40 --at-once     # boards of a frame, in the configurations

Scenes of the test split with boards on both sides of junctions, eight key frames half a second apart, no noise. "field
of view" is the simulation that knows neither the upper edge of an image nor masts, signs, lamp posts and trees.

--at-once counts the boards of one frame, and their lanes in the perception range: what the capacities
`MarkerConfig.markers` and `MarkerPriorConfig.lanes` cut off. "detected" is the configuration's simulation, "visible"
has all boards in sight.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np

from benchmarks.timing import command_line, markdown_table
from tflane_jax.config import WorldData, load_config
from tflane_jax.datasets.marker_observations import markers_of, store_of_log
from tflane_jax.datasets.procedural import FIRST_SCENE, ProceduralConfig, ProceduralDataset
from tflane_jax.markers.observe import observe
from tflane_jax.markers.simulation import PERFECT, simulate_detections
from tflane_jax.scene.logs import KeyFrame, Log
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING
from tflane_jax.world.roads.markers import PlacementConfig
from tflane_jax.world.simulate import WorldConfig, simulate

SIMULATIONS = {
    "field of view": PERFECT,
    "Argoverse 2": replace(PERFECT, cameras=ARGOVERSE2_RING, occlusion="bodies"),
    "nuScenes": replace(PERFECT, cameras=NUSCENES_RING, occlusion="bodies"),
}
# Whose boards are counted, and more lanes than a board knows.
CONFIGS = ("markers/toponet_markers", "markers/camera_clips")
_LANES = 64
_AT_ONCE = (
    *("boards", "frames", "with 0", "in a gap", "with 1", "with 2", "with 3 or more"),
    *("lanes of a frame's boards, median", "frames with more than the prior takes"),
)
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


def at_once(name: str, scenes: int) -> list[list[str]]:
    """Return rows of the second table: boards and lanes of the frames of a configuration's test split."""
    config = load_config(name)
    assert isinstance(config.data, WorldData)
    assert isinstance(config.task, LaneGraphTask)
    source = config.data.source("test")
    assert isinstance(source, ProceduralConfig)
    markers, prior = source.example.markers, config.task.model.priors.markers
    assert markers is not None
    assert prior is not None
    simulation = markers.simulation
    every = replace(PERFECT, cameras=simulation.cameras, occlusion=simulation.occlusion)
    boards, lanes, gaps = (np.zeros((2, 0), int) for _ in range(3))
    for log in ProceduralDataset(replace(source, scenes=scenes)).drives():
        store = store_of_log(log, radius=markers.radius, bike_lanes=source.example.bike_lanes == "include")
        ever = np.zeros(2, bool)
        for moment in log.keyframes:
            found = [simulate_detections(log, moment, markers_of(log), each) for each in (simulation, every)]
            seen = [
                observe(each, store, source.example.range, markers=markers.markers, lanes=_LANES, points=2).markers
                for each in found
            ]
            count = np.array([each.valid.sum() for each in found])
            boards = np.column_stack([boards, count])
            lanes = np.column_stack([lanes, [each.lane_valid.sum() for each in seen]])
            gaps = np.column_stack([gaps, (count == 0) & ever])
            ever |= count > 0
    rows = []
    for kind, count, known, gap in zip(("detected", "visible"), boards, lanes, gaps, strict=True):
        some = known[count > 0]
        fractions = [(count == 0).mean(), gap.mean(), (count == 1).mean(), (count == 2).mean(), (count > 2).mean()]
        cut = [f"{np.median(some):.0f}", f"{(some > prior.prior.lanes).mean():.1%}"] if len(some) else ["-", "-"]
        rows.append([f"{name}, {kind}", str(len(count)), *(f"{fraction:.1%}" for fraction in fractions), *cut])
    return rows


def main() -> None:
    """Parse the command line, measure and print."""
    parser = command_line(__doc__, out=None, scenes=40)
    parser.add_argument("--at-once", action="store_true", help="count the boards of a frame instead")
    options = parser.parse_args()
    scenes: int = options.scenes
    if options.at_once:
        print(markdown_table(_AT_ONCE, [row for name in CONFIGS for row in at_once(name, scenes)]))
        return
    bands = [f"boards at {low:g} to {high:g} m" for low, high in _BANDS]
    rows = measure("junction", scenes) + measure("clear", scenes)
    print(markdown_table(["site", "visible", "frames that see one", *bands], rows))


if __name__ == "__main__":
    main()
