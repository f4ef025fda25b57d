"""Single scenes of the nuScenes folder by name, with the map around them, for `road_maps`."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path

from tflane_jax.datasets.nuscenes_log import scene_frames, scene_log
from tflane_jax.datasets.nuscenes_map import MapExpansion, read_expansion
from tflane_jax.datasets.nuscenes_tables import Tables, read_tables
from tflane_jax.errors import UserError
from tflane_jax.files.fields import load_json, member
from tflane_jax.scene.logs import Log

SCENE_TABLE = "scene.json"
# Distance from the drive up to which elements of the map are taken, metres: the ego vehicle starts up to 100 m away.
_REACH = 180.0


def scene_files(scenes: Path) -> Iterator[tuple[str, tuple[Path, ...]]]:
    """Yield the name of each scene and the files that tell its map: small tables, and the expansion of its city.

    Args:
        scenes: the table scene.json, beside the others.

    Raises UserError for tables that are missing or damaged.
    """
    logs = scenes.with_name("log.json")
    city = {member(row, "token", str(logs)): member(row, "location", str(logs)) for row in load_json(logs)}
    expansions = scenes.parent.parent / "maps" / "expansion"
    for row in load_json(scenes):
        place = city.get(member(row, "log_token", str(scenes)))
        if place is None:
            raise UserError(f"{scenes}: scene {row.get('name')} names a log that is not in {logs}")
        yield str(member(row, "name", str(scenes))), (scenes, logs, expansions / f"{place}.json")


def read_scene(folder: Path, name: str) -> Log:
    """Read a scene with the map around it; raise UserError for files that are missing or damaged.

    Args:
        folder: of the tables, such as <root>/v1.0-mini.
        name: of the scene.
    """
    tables = _tables(folder)
    scene = tables.scenes()[name]
    frames = scene_frames(tables, scene)
    expansion = _expansion(folder.parent / "maps" / "expansion" / f"{tables.location(scene)}.json")
    return scene_log(tables, scene, frames, expansion.around(frames.global_from_frame[:, :2, 3], _REACH))


@functools.lru_cache(maxsize=1)
def _tables(folder: Path) -> Tables:
    return read_tables(folder)


@functools.lru_cache(maxsize=4)
def _expansion(path: Path) -> MapExpansion:
    return read_expansion(path)
