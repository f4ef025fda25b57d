"""Scenes of nuScenes as plain npz files: tracks, ego path, lanes, dividers and the drivable boundary of one scene each.

A file has what ScenarioNet keeps of a scene (https://github.com/metadriverse/scenarionet): boxes by instance at 2 Hz,
lane outlines with center lines, dividers, the border of the drivable area. It has no images, no crossings and no
visibility. It has no connectivity either: lanes are joined where their ends coincide. Keys:

    instance_token, category (K,); size_wlh (K, 3); position (F, K, 3); yaw, valid (F, K); ego_position (F, 3);
    ego_yaw (F,); map_token, map_type, polyline_len, polygon_len (M,); polyline, polygon (n, 2), the points of all
    elements in succession; meta, a JSON text with scene and rate_hz, and location if it is known

Global metres; no pickle inside.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.lane_outlines import LaneOutline, boundaries
from tflane_jax.datasets.log_frames import LogOutline
from tflane_jax.datasets.nuscenes_log import CATEGORIES, road_user, side_of
from tflane_jax.datasets.nuscenes_map import flat
from tflane_jax.datasets.plausible import (
    LONGEST,
    SHORTEST,
    check_distance,
    check_headings,
    check_motion,
    check_place,
    check_steps,
)
from tflane_jax.errors import UserError
from tflane_jax.files.fields import member, numbers, parse_json
from tflane_jax.files.npz import read_npz
from tflane_jax.files.wording import file_name
from tflane_jax.geometry import invert_pose, line_distances, transform_points, without_repeats, wrap_angle, yaw_pose
from tflane_jax.scene import LineType, RoadUser
from tflane_jax.scene.logs import KeyFrame, LaneSegment, Log, Tracks, VectorMap

# Metres. Ends of lanes that continue one another coincide to rounding; the next nearest are metres apart.
_SAME_END = 0.1
# Metres; a lane's side runs along a divider if its points are nearer than this, as the sides of neighbours are.
_ON_DIVIDER = 0.75
_TEXTS = ("instance_token", "category", "map_token", "map_type")
_BOUNDARY = "boundary_"  # tokens of the pieces of the drivable area's border start with this


def read_scene_file(path: Path, *, categories: Mapping[str, RoadUser | None] = CATEGORIES) -> Log:
    """Read one scene; every key frame becomes an example.

    Args:
        path: of the file.
        categories: road user of each category, None to leave it out, see `road_user`.

    Raises UserError, which names file and key, for a file that is missing or damaged, or that holds numbers that are
    not finite or arrays that do not fit each other.
    """
    path = Path(path)
    content = _content(path)
    outline = _outline(content, path)
    times = np.array([moment.timestamp_ns for moment in outline.keyframes], np.int64)
    pose = np.stack([moment.global_from_ego for moment in outline.keyframes])
    vector_map = _vector_map(content, path)
    lanes = [lane.centerline for lane in vector_map.segments.values()]
    check_place(lanes, content["ego_position"][:, :2], str(path))
    tracks = _tracks(content, pose, categories, path)
    check_headings(tracks, pose, times, f"{path}: yaw")
    return Log(
        name=outline.name,
        source=outline.source,
        map=replace(vector_map, side=side_of(outline.area)),
        timestamps_ns=times,
        global_from_ego=pose,
        tracks=tracks,
        actors=tracks,
        keyframes=outline.keyframes,
        seed=zlib.crc32(outline.name.encode()),
        area=outline.area,
    )


def scene_file_outline(path: Path) -> LogOutline:
    """Return the key frames of a scene as `read_scene_file` does, without map and boxes; raises UserError like it."""
    return _outline(read_npz(path, ("ego_position", "ego_yaw", "meta")), path)


def scene_file_name(path: Path) -> str:
    """Return the name of a scene, that of its log, whatever the file's; of a damaged file its own."""
    try:
        return _meta(member(read_npz(path, ("meta",)), "meta", str(path)), f"{path}: meta")[0]
    except UserError:  # reading the scene tells what is wrong
        return path.stem


def _outline(content: Mapping[str, Any], path: Path) -> LogOutline:
    where = str(path)
    name, period_ns, area = _meta(member(content, "meta", where), f"{path}: meta")
    position = numbers(member(content, "ego_position", where), (None, 3), f"{path}: ego_position").astype(np.float64)
    if not len(position):
        raise UserError(f"{path}: ego_position holds no key frame")
    yaw = numbers(member(content, "ego_yaw", where), (len(position),), f"{path}: ego_yaw").astype(np.float64)
    times = np.arange(len(position), dtype=np.int64) * period_ns
    check_motion(position[:, :2], times, [f"{path}: ego_position[{i}]" for i in range(len(position))])
    x, y, _ = position.T
    poses = zip(times.tolist(), yaw_pose(x, y, yaw), strict=True)
    keyframes = tuple(KeyFrame(time, pose, i) for i, (time, pose) in enumerate(poses))
    return LogOutline(name, "nuscenes-scenes", area, keyframes)


def _content(path: Path) -> dict[str, Any]:
    """Return the checked arrays of a file: numbers are finite, and sizes fit."""
    content: dict[str, Any] = dict(read_npz(path))
    where = str(path)
    for key in _TEXTS:
        if np.asarray(member(content, key, where)).dtype.kind != "U" or content[key].ndim != 1:
            raise UserError(f"{path}: {key} must be a list of texts")
    valid = np.asarray(member(content, "valid", where))
    if valid.dtype != bool or valid.ndim != 2 or not len(valid):
        raise UserError(f"{path}: valid has type {valid.dtype} and shape {valid.shape}, expected bool (frames, tracks)")
    (frames, tracks), elements = valid.shape, len(content["map_type"])
    shapes = {"size_wlh": (tracks, 3), "position": (frames, tracks, 3), "yaw": (frames, tracks)}
    shapes |= {"ego_position": (frames, 3), "ego_yaw": (frames,), "polyline": (None, 2), "polygon": (None, 2)}
    for key, shape in shapes.items():
        content[key] = numbers(member(content, key, where), shape, f"{path}: {key}").astype(np.float64)
    for key, size in (("instance_token", tracks), ("category", tracks), ("map_token", elements)):
        if len(content[key]) != size:
            raise UserError(f"{path}: {key} has {len(content[key])} entries, expected {size}")
    if len(set(content["instance_token"].tolist())) != tracks:
        raise UserError(f"{path}: instance_token names a track twice")
    if (content["size_wlh"] <= 0.0).any():
        raise UserError(f"{path}: size_wlh holds a size that is not positive")
    for key in ("polyline", "polygon"):
        lengths = np.asarray(member(content, f"{key}_len", where))
        if lengths.dtype.kind not in "iu" or lengths.shape != (elements,) or (lengths < 0).any():
            raise UserError(f"{path}: {key}_len must be {elements} whole numbers")
        if lengths.sum() != len(content[key]):
            raise UserError(f"{path}: {key}_len adds up to {lengths.sum()}, but {key} has {len(content[key])} points")
        content[key] = np.split(content[key], np.cumsum(lengths)[:-1])
    member(content, "meta", where)
    return content


def _meta(text: np.ndarray, where: str) -> tuple[str, int, str]:
    """Return the scene's name, the time between frames (nanoseconds), and its city, "" where it is not recorded."""
    meta = parse_json(str(text), where, "JSON text")
    rate = float(numbers(member(meta, "rate_hz", where), (), f"{where}: rate_hz"))
    name = file_name(member(meta, "scene", where), f"{where}: scene")
    if not 1.0 / LONGEST <= rate <= 1.0 / SHORTEST:
        raise UserError(f"{where}: rate_hz must be key frames a second, not {rate:g}")
    area = meta.get("location", "")
    return name, round(1e9 / rate), area if isinstance(area, str) else ""


def _tracks(
    content: dict[str, Any],
    pose: Float[np.ndarray, "f 4 4"],
    categories: Mapping[str, RoadUser | None],
    path: Path,
) -> Tracks:
    users = [road_user(str(name), f"{path}: category", categories) for name in content["category"]]
    kept = [i for i, user in enumerate(users) if user is not None]
    valid = content["valid"][:, kept]
    tracks = Tracks.empty(len(valid), content["instance_token"][kept])
    tracks.valid[:] = valid
    tracks.size[:] = content["size_wlh"][kept][:, [1, 0, 2]]
    tracks.category[:] = [users[i] for i in kept]
    position = transform_points(invert_pose(pose), content["position"][:, kept])
    yaw = content["yaw"][:, kept] - content["ego_yaw"][:, None]
    seen = np.argwhere(valid)
    check_distance(position[valid], [f"{path}: position[{f}, {kept[k]}]" for f, k in seen])
    tracks.position[:] = np.where(valid[..., None], position, 0.0)
    tracks.yaw[:] = np.where(valid, wrap_angle(yaw), 0.0)
    return tracks


def _vector_map(content: dict[str, Any], path: Path) -> VectorMap:
    lanes: dict[int, LaneOutline] = {}
    border: list[np.ndarray] = []
    dividers: list[tuple[np.ndarray, LineType]] = []
    elements = zip(content["map_type"].tolist(), content["map_token"].tolist(), strict=True)
    for number, (kind, token) in enumerate(elements):
        for key in ("polyline", "polygon"):
            check_steps(content[key][number], f"{path}: {key} of {token}")
        # The joints of its arcs are there twice.
        line, polygon = without_repeats(content["polyline"][number], 1e-4), content["polygon"][number]
        if kind.startswith("LANE_"):
            if len(line) > 1:
                lanes[number] = LaneOutline(line, polygon if len(polygon) else None)
        elif not kind.startswith("ROAD_LINE_"):
            raise UserError(f"{path}: map_type {kind!r} of {token} is neither LANE_... nor ROAD_LINE_...")
        elif len(line) > 1 and token.startswith(_BOUNDARY):
            border.append(line)
        elif len(line) > 1:
            dividers.append((line, LineType.DASHED if "BROKEN" in kind else LineType.SOLID))
    after = _following(lanes)
    sides = boundaries(lanes, after)
    segments = {
        number: LaneSegment(
            id=number,
            centerline=flat(lane.centerline),
            left=flat(sides[number][0]),
            right=flat(sides[number][1]),
            left_type=_marking(sides[number][0], lane, dividers),
            right_type=_marking(sides[number][1], lane, dividers),
            is_intersection=lane.outline is None,
            successors=after[number],
        )
        for number, lane in lanes.items()
    }
    return VectorMap(
        segments=segments,
        road_boundaries=tuple(map(flat, border)),
        dividers=tuple(flat(line) for line, _ in dividers),
    )


def _following(lanes: dict[int, LaneOutline]) -> dict[int, tuple[int, ...]]:
    """Return the lanes that start where each lane ends."""
    numbers_ = np.array(list(lanes), int)
    starts, ends = (np.array([lane.centerline[i] for lane in lanes.values()]).reshape(-1, 2) for i in (0, -1))
    joined = np.linalg.norm(ends[:, None] - starts, axis=-1) < _SAME_END
    np.fill_diagonal(joined, False)
    return {int(number): tuple(numbers_[row].tolist()) for number, row in zip(numbers_, joined, strict=True)}


def _marking(
    side: Float[np.ndarray, "n 2"], lane: LaneOutline, dividers: list[tuple[np.ndarray, LineType]]
) -> LineType:
    """Return the marking of the divider along which most of a lane's side runs; none for lanes without an outline."""
    if lane.outline is None:
        return LineType.NONE
    near = {kind: np.zeros(len(side), bool) for kind in (LineType.SOLID, LineType.DASHED)}
    for line, kind in dividers:
        near[kind] |= line_distances(side, line)[0] < _ON_DIVIDER
    most = max(near, key=lambda kind: near[kind].mean())
    return most if near[most].mean() > 0.5 else LineType.NONE


def find_scene_files(root: Path) -> list[Path]:
    """Return the file itself, or the npz files of a folder by name; raises UserError if there is none."""
    root = Path(root)
    if not root.exists():
        raise UserError(f"there is no {root}: name a scene file (npz) or a folder of them")
    if root.is_file() and root.suffix != ".npz":
        raise UserError(f"{root} is no scene file (npz), and no folder of them")
    found = [root] if root.is_file() else sorted(root.glob("*.npz"))
    if not found:
        raise UserError(f"{root} holds no scene file (*.npz)")
    return found
