"""What is in a folder of nuScenes, and what is wrong with it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from tflane_jax.datasets.data_source import FolderCheck
from tflane_jax.datasets.nuscenes_cameras import missing_images
from tflane_jax.datasets.nuscenes_log import SceneFrames, scene_frames, scene_tracks
from tflane_jax.datasets.nuscenes_map import MapExpansion, read_expansion
from tflane_jax.datasets.nuscenes_splits import MISPLACED
from tflane_jax.datasets.nuscenes_tables import find_tables, read_tables
from tflane_jax.datasets.plausible import FAR, check_place
from tflane_jax.errors import UserError


def check_nuscenes(root: Path) -> FolderCheck:
    """Read every table, every scene and the map of every city; images are only looked for.

    A folder without `samples` is one of tables and maps, for models that see no images: that is no fault.

    Raises UserError where there are no tables or they cannot be joined.
    """
    tables = read_tables(find_tables(root))
    faults: list[str] = []
    maps: dict[str, MapExpansion | None] = {}
    counts: dict[str, Counter[str]] = {}
    samples = tables.root / "samples"
    skipped = [] if samples.is_dir() else [f"images were not looked for: there is no {samples}"]
    if not tables.scenes():
        faults.append(f"{tables.folder / 'scene.json'} holds no scene: unpack the tables again")
    for name, scene in sorted(tables.scenes().items()):
        location = tables.location(scene)
        if location not in maps:
            maps[location] = _checked_map(tables.map_path(location), faults)
        count = counts.setdefault(location, Counter())
        count["scenes"] += 1
        try:
            frames = scene_frames(tables, scene)
            tracks = scene_tracks(tables, frames)
            if name not in MISPLACED:
                _check_scene_place(maps[location], frames, f"{name} on the map of {location}")
        except UserError as error:
            faults.append(f"{name}: {error}")
            continue
        absent = [] if skipped else missing_images(tables, frames.samples)
        if absent:
            faults.append(f"{name}: {len(absent)} images are missing (first {absent[0]})")
        count.update({"key frames": tracks.frames, "road users": len(tracks.uuid)})
        count.update({"boxes": int(tracks.valid.sum()), "missing images": len(absent)})
    rows = [_row(location, counts[location], maps[location]) for location in counts]
    return FolderCheck(f"nuScenes, {tables.folder.name}", rows, faults, skipped)


def _checked_map(path: Path, faults: list[str]) -> MapExpansion | None:
    try:
        return read_expansion(path)
    except UserError as error:
        faults.append(str(error))
        return None


def _check_scene_place(expansion: MapExpansion | None, frames: SceneFrames, where: str) -> None:
    if expansion is not None:
        path = frames.global_from_frame[:, :2, 3]
        check_place([lane.centerline for lane in expansion.lanes_near(path, FAR).values()], path, where)


def _row(location: str, count: Counter[str], expansion: MapExpansion | None) -> dict[str, int | str]:
    names = ("scenes", "key frames", "road users", "boxes", "missing images")
    found: dict[str, int | str] = {"location": location, **{name: count[name] for name in names}}
    if expansion is None:
        return found | dict.fromkeys(("lanes", "without arcline", "dividers", "crossings"), 0)
    found |= {"lanes": len(expansion.lanes), "without arcline": len(expansion.without_line)}
    return found | {"dividers": len(expansion.dividers), "crossings": len(expansion.crossings)}
