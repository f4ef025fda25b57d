"""What is in a folder of nuScenes, and what is wrong with it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from tflane_jax.datasets.data_source import FolderCheck
from tflane_jax.datasets.nuscenes_cameras import camera_fits, missing_images, sample_cameras
from tflane_jax.datasets.nuscenes_folder import find_tables
from tflane_jax.datasets.nuscenes_log import SceneFrames, scene_frames, scene_tracks
from tflane_jax.datasets.nuscenes_map import MapExpansion, read_expansion
from tflane_jax.datasets.nuscenes_splits import MISPLACED
from tflane_jax.datasets.nuscenes_tables import Tables, read_tables
from tflane_jax.datasets.openlane_check_cameras import damage_of, image_size
from tflane_jax.datasets.plausible import FAR, check_place
from tflane_jax.datasets.view_images import ImageConfig
from tflane_jax.errors import UserError
from tflane_jax.files.wording import counted
from tflane_jax.progress import progress_bar


def check_nuscenes(root: Path) -> FolderCheck:
    """Read every table, every scene, the map of every city, and the start and end of every image.

    A folder without `samples` is one of tables and maps, for models that see no images: that is no fault.

    Raises UserError where there are no tables or they cannot be joined.
    """
    tables = read_tables(find_tables(root))
    faults: list[str] = []
    maps: dict[str, MapExpansion | None] = {}
    counts: dict[str, Counter[str]] = {}
    samples = tables.root / "samples"
    skipped = [] if samples.is_dir() else [f"images were not looked for: there is no {samples}"]
    if not skipped:
        try:
            camera_fits(tables, ImageConfig())
        except UserError as error:
            faults.append(str(error))
    if not tables.scenes():
        faults.append(f"{tables.folder / 'scene.json'} holds no scene: unpack the tables again")
    for name, scene in progress_bar(sorted(tables.scenes().items()), "checking", unit="scene"):
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
            faults.append(f"{name} lacks {counted(len(absent), 'image')} (first {absent[0]})")
        if not skipped:
            faults += [f"{name}: {fault}" for fault in _camera_faults(tables, frames)]
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


def _camera_faults(tables: Tables, frames: SceneFrames) -> list[str]:
    """Return what keeps the images of a scene from being examples: the first of each kind, and how many there are."""
    faults, damaged, sized = [], [], []
    for sample, pose in zip(frames.samples, frames.global_from_ego, strict=True):
        try:
            cameras = sample_cameras(tables, sample, pose)
        except UserError as error:
            return [str(error)]
        for camera in cameras:
            if camera is None or not camera.image.is_file():
                continue
            row = tables.data[sample["token"]][camera.name]
            if fault := damage_of(camera.image, "ends"):
                damaged.append(f"{camera.image} {fault}")
            elif (size := image_size(camera.image)) != (row["width"], row["height"]) and size is not None:
                given = f"{row['width']} x {row['height']} in the tables"
                sized.append(f"{camera.image} is {size[0]} x {size[1]} pixels, {given}")
    for found in (damaged, sized):
        if found:
            faults.append(found[0] + (f" ({len(found)} images of the scene)" if len(found) > 1 else ""))
    return faults


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
