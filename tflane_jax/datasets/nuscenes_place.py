"""Single scenes of the nuScenes folder by name, with the map around them, for `road_maps`."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tflane_jax.datasets.log_frames import LogOutline
from tflane_jax.datasets.nuscenes_log import key_frames, scene_frames, scene_log
from tflane_jax.datasets.nuscenes_map import MapExpansion, read_expansion
from tflane_jax.datasets.nuscenes_tables import TABLES, check_tables, file_state, shared_tables
from tflane_jax.errors import UserError
from tflane_jax.files.fields import member
from tflane_jax.files.json_rows import json_rows
from tflane_jax.files.wording import file_name, shown
from tflane_jax.scene.logs import Log

SCENE_TABLE = "scene.json"
# Distance from the drive up to which elements of the map are taken, metres: the ego vehicle starts up to 100 m away.
_REACH = 180.0


def scene_files(scenes: Path) -> Iterator[tuple[str, tuple[Path, ...]]]:
    """Yield the name of each scene and the files on which its map depends: the tables, and the expansion of its city.

    The tables tell the drive, near which the world drives, and the parked vehicles.

    Args:
        scenes: the table scene.json, beside the others.

    Raises UserError for tables that are missing or damaged.
    """
    check_tables(scenes.parent)
    logs = scenes.with_name("log.json")
    city = {_text(row, "token", logs): _text(row, "location", logs) for row in json_rows(logs)}
    others = tuple(scenes.with_name(f"{name}.json") for name in TABLES if f"{name}.json" != scenes.name)
    expansions = scenes.parent.parent / "maps" / "expansion"
    for row in json_rows(scenes):
        name = file_name(member(row, "name", f"{scenes}: a row"), f"{scenes}: name")
        place = city.get(_text(row, "log_token", scenes))
        if place is None:
            raise UserError(f"{scenes}: scene {name} names a log that is not in {logs}")
        place = file_name(place, f"{logs}: location")
        yield name, (scenes, *others, expansions / f"{place}.json")


def _text(row: Any, column: str, path: Path) -> str:
    value = member(row, column, f"{path}: a row")
    if not isinstance(value, str):
        raise UserError(f"{path}: {column} is {shown(value)}, expected text")
    return value


def read_scene(folder: Path, name: str) -> Log:
    """Read a scene with the map around it; raise UserError for files that are missing or damaged.

    Args:
        folder: of the tables, such as <root>/v1.0-mini.
        name: of the scene.
    """
    tables = shared_tables(folder)
    scene = tables.scenes()[name]
    frames = scene_frames(tables, scene)
    expansion = _expansion(folder.parent / "maps" / "expansion" / f"{tables.location(scene)}.json")
    return scene_log(tables, scene, frames, expansion.around(frames.global_from_frame[:, :2, 3], _REACH))


def scene_outline(folder: Path, name: str) -> LogOutline:
    """Return the key frames of a scene as `read_scene` does, without map and boxes; raises UserError like it."""
    tables = shared_tables(folder)
    scene = tables.scenes()[name]
    return LogOutline(name, "nuscenes", tables.location(scene), key_frames(scene_frames(tables, scene)))


def _expansion(path: Path) -> MapExpansion:
    return _kept_expansion(path, file_state(path))


@functools.lru_cache(maxsize=4)
def _kept_expansion(path: Path, state: tuple[int, int] | None) -> MapExpansion:
    return read_expansion(path)
