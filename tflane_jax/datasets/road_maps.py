"""Maps of recorded logs as places for the built-in world: `Log` -> `RoadMap`, and all that a folder holds."""

from __future__ import annotations

import hashlib
import itertools
import os
import zipfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, load_log, log_outline
from tflane_jax.datasets.argoverse2_map import MAP_PATTERN
from tflane_jax.datasets.argoverse2_poses import POSES
from tflane_jax.datasets.geojson_lanes import read_lanes
from tflane_jax.datasets.log_frames import LogOutline
from tflane_jax.datasets.nuscenes_place import SCENE_TABLE, read_scene, scene_files, scene_outline
from tflane_jax.datasets.nuscenes_scene_files import read_scene_file, scene_file_name, scene_file_outline
from tflane_jax.datasets.openlane_maps import map_name, read_segment, segment_files
from tflane_jax.errors import UserError
from tflane_jax.files.digests import file_content
from tflane_jax.files.folders import named_folder
from tflane_jax.geometry import pose_yaw, transform_points
from tflane_jax.scene import RoadUser
from tflane_jax.scene.logs import Log
from tflane_jax.world.roads.map_roadside import lane_points
from tflane_jax.world.roads.road_map import RoadMap

# Distance from the drive up to which the lanes of a scene file are complete, metres: it holds the lanes around the
# drive whole, so most reach farther.
_SCENE_FILE = 72.0
# The same for a map that cuts no lane, and the most that is believed, metres.
_UNCUT, _MOST = 100.0, 120.0
_SENSOR_FOLDERS = ("samples", "sweeps", "sensors", "image")
# A vehicle that moves less for at least this long, off every centerline, is parked: metres, seconds, metres.
_STANDS, _LONG, _OFF_LANE = 1.0, 4.0, 1.2


@dataclass(frozen=True)
class MapFile:
    """A map in a folder.

    Attributes:
        name: of the log, unique in the folder.
        files: of which it is made.
        kind: format.
    """

    name: str
    files: tuple[Path, ...]
    kind: str

    @property
    def recorded(self) -> bool:
        """Whether the map is that of a log with key frames and tracks; GeoJSON and OpenLane-V2 give the map alone."""
        return self.kind not in ("geojson", "openlane_v2")

    def content(self) -> str:
        """Return the hash of all that the map depends on."""
        return hashlib.sha256(self.name.encode() + b"".join(map(file_content, self.files))).hexdigest()

    def log(self) -> Log:
        """Read the log; raise UserError if a file is missing or damaged, or if the map is not that of a log."""
        self._check_recorded()
        if self.kind == "nuscenes":
            return read_scene(self.files[0].parent, self.name)
        if self.kind == "argoverse2":
            return load_log(self.files[0].parent)
        return read_scene_file(self.files[0])

    def outline(self) -> LogOutline:
        """Read the key frames of the log, without map and boxes; raises UserError as `log` does."""
        self._check_recorded()
        if self.kind == "nuscenes":
            return scene_outline(self.files[0].parent, self.name)
        if self.kind == "argoverse2":
            return log_outline(self.files[0].parent)
        return scene_file_outline(self.files[0])

    def _check_recorded(self) -> None:
        if not self.recorded:
            raise UserError(f"{self.files[0]} is a map without a recording: name a log")

    def read(self) -> RoadMap:
        """Read the map; raise UserError if a file is missing or damaged."""
        if self.kind == "openlane_v2":
            return read_segment(self.files)
        if self.kind == "geojson":
            return read_lanes(self.files[0])
        return road_map_of(self.log())


def content_of(maps: Collection[MapFile]) -> str:
    """Return the hash of all that several maps depend on, in their order."""
    return hashlib.sha256("".join(one.content() for one in maps).encode()).hexdigest()


def map_of_log(folder: Path) -> MapFile:
    """Return the map of a log of Argoverse 2, with its boxes and poses."""
    maps = sorted((folder / "map").glob(MAP_PATTERN))
    return MapFile(folder.name, (folder / ANNOTATIONS, folder / POSES, *maps), "argoverse2")


def find_maps(root: Path) -> list[MapFile]:
    """Return the maps below a folder, or that of a single log, by name.

    Known are logs of Argoverse 2 (annotations.feather with its map), scenes of the nuScenes folder with its map
    expansion and scene files of nuScenes (npz), segments of OpenLane-V2 (`openlane_maps`), and lanes as GeoJSON
    (`geojson_lanes`).

    A folder that links lead to twice, or back to one above it, is read once.

    Raises UserError if there is none, or if two have the same name.
    """
    root = named_folder(root)  # that of one log tells its name
    if not root.exists():
        raise UserError(f"there is no {root}: name a folder of logs, or one log")
    found = sorted(_found(root), key=lambda one: one.name)
    if not found:
        formats = (
            f"Argoverse 2 logs ({ANNOTATIONS}), nuScenes (scene.json, or scene files npz), OpenLane-V2 "
            "(<segment>/info/<timestamp>.json) or lanes (geojson)"
        )
        raise UserError(f"{root} holds no map: expected {formats}")
    for one, other in itertools.pairwise(found):
        if one.name == other.name:
            raise UserError(
                f"{root} holds two maps with the name {one.name}: take out {one.files[0]} or {other.files[0]}"
            )
    return found


def chosen_maps(root: Path, logs: Collection[str], without: Collection[str] = ()) -> list[MapFile]:
    """Return the maps of these logs, or of all if none is named, but for those to leave out.

    Raises UserError as `find_maps` does, and if a named log is missing or none is left.
    """
    found = {one.name: one for one in find_maps(root)}
    if missing := {*logs, *without} - set(found):
        files = {one.files[0].stem: one.name for one in found.values()}
        of_file = f" ({min(missing)} is the file of {files[min(missing)]})" if min(missing) in files else ""
        raise UserError(f"{root} has no log {min(missing)}{of_file}, only {', '.join(found)}")
    maps = [one for name, one in found.items() if name in (logs or found) and name not in without]
    if not maps:
        raise UserError(f"no map of {root} is left: every log belongs to another split")
    return maps


def _found(root: Path) -> Iterator[MapFile]:
    segments: set[Path] = set()
    for file in [root] if root.is_file() else _files(root):
        if file.suffix == ".npz" and _may_hold_lanes(file):
            yield MapFile(scene_file_name(file), (file,), "nuscenes-scenes")
        elif file.suffix == ".geojson":
            yield MapFile(file.stem, (file,), "geojson")
        elif file.name == ANNOTATIONS:
            yield map_of_log(file.parent)
        elif file.name == SCENE_TABLE:
            for name, files in scene_files(file):
                yield MapFile(name, files, "nuscenes")
        elif file.suffix == ".json" and file.parent.name == "info" and file.parent not in segments:
            # One map for all files of the folder.
            segments.add(file.parent)
            if files := segment_files(file.parent):
                yield MapFile(map_name(file.parent.parent), files, "openlane_v2")


def _files(root: Path) -> Iterator[Path]:
    """Yield all files below a folder, but for those in folders of images and sweeps, which are many."""
    seen = {os.path.realpath(root)}
    for folder, inner, names in os.walk(root, followlinks=True):
        places = [os.path.join(folder, name) for name in inner if name not in _SENSOR_FOLDERS]
        inner.clear()
        for place in sorted(places, key=lambda place: (os.path.islink(place), place)):
            if (real := os.path.realpath(place)) not in seen:
                seen.add(real)
                inner.append(os.path.basename(place))
        yield from (Path(folder) / name for name in sorted(names))


def _may_hold_lanes(file: Path) -> bool:
    """Return False for an npz file of something else; reading a damaged one tells what is wrong with it."""
    try:
        with zipfile.ZipFile(file) as archive:
            return "map_type.npy" in archive.namelist()
    # A damaged archive may raise any error of zipfile.
    except Exception:
        return True


def road_map_of(log: Log) -> RoadMap:
    """Return the map of a log as a place for the built-in world."""
    places = log.global_from_ego[:, :2, 3]
    complete = _SCENE_FILE if log.source == "nuscenes-scenes" else _cut_at(log)
    return RoadMap(log.name, log.source, log.map, places, complete, _parked(log), log.area)


def _cut_at(log: Log) -> float:
    """Return the distance from the drive to the nearest lane whose successor is not in the map, metres."""
    ends = [s.centerline[-1, :2] for s in log.map.segments.values() if set(s.successors) - set(log.map.segments)]
    places = log.global_from_ego[:, :2, 3]
    return min(min((float(np.linalg.norm(places - end, axis=-1).min()) for end in ends), default=_UNCUT), _MOST)


def _parked(log: Log) -> Float[np.ndarray, "p 3"]:
    """Return x, y and yaw of the vehicles that stand still beside the lanes as long as they are seen."""
    from scipy.spatial import KDTree

    tracks, found = log.tracks, [np.zeros((0, 3))]
    lanes = KDTree(lane_points(log.map.segments.values()))
    position = transform_points(log.global_from_ego, tracks.position)[..., :2]
    yaw = tracks.yaw + pose_yaw(log.global_from_ego)[:, None]
    for k in np.flatnonzero(tracks.category <= RoadUser.BUS):
        seen = np.flatnonzero(tracks.valid[:, k])
        if len(seen) < 2 or log.timestamps_ns[seen[-1]] - log.timestamps_ns[seen[0]] < _LONG * 1e9:
            continue
        middle = np.median(position[seen, k], axis=0)
        moved = np.linalg.norm(position[seen, k] - middle, axis=-1).max()
        if moved < _STANDS and lanes.query(middle)[0] > _OFF_LANE:
            found.append(np.array([[*middle, yaw[seen[len(seen) // 2], k]]]))
    return np.concatenate(found)
