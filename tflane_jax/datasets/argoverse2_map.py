"""The vector map of an Argoverse 2 sensor log: `map/log_map_archive_*.json` -> `VectorMap`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.datasets.plausible import area_between, check_steps, first_twice
from tflane_jax.datasets.shapely_polygons import flat_rings, import_shapely
from tflane_jax.errors import UserError
from tflane_jax.files.fields import items, load_json, member, numbers, whole_number
from tflane_jax.geometry.polylines import resample
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment, VectorMap

_AREAS = ("pedestrian_crossings", "drivable_areas")
_LARGEST_ID = 2**63 - 1
MAP_PATTERN = "log_map_archive_*.json"
# Argoverse 2's own API makes centerlines of ten points.
_CENTERLINE_POINTS = 10


def read_map(folder: Path) -> VectorMap:
    """Read the map file in `folder`; raise UserError if it is missing or damaged, or there are several."""
    found = sorted(folder.glob(MAP_PATTERN))
    if not found:
        raise UserError(f"{folder} holds no {MAP_PATTERN}: download the log's map folder")
    if len(found) > 1:
        raise UserError(f"{folder} holds two maps, {found[0].name} and {found[1].name}: take out that of another log")
    (path,) = found
    archive, where = load_json(path), str(path)
    lanes, crossings, areas = (member(archive, name, where) for name in ("lane_segments", *_AREAS))
    segments = [_lane_segment(lane, f"{where}: lane_segments.{key}") for key, lane in _entries(lanes, where)]
    if not segments:
        raise UserError(f"{path} holds no lane segment: download it again")
    by_id = {segment.id: segment for segment in segments}
    if (twice := first_twice([segment.id for segment in segments])) is not None:
        raise UserError(f"{path} has two lane segments with the id {twice}: download it again")
    return VectorMap(
        segments=by_id,
        crossings=tuple(_crossing(c, f"{where}: pedestrian_crossings.{k}") for k, c in _entries(crossings, where)),
        road_boundaries=_boundaries(
            [_points(a, "area_boundary", f"{where}: drivable_areas.{k}", 3) for k, a in _entries(areas, where)]
        ),
    )


def _entries(records: Any, where: str) -> list[tuple[str, Any]]:
    if not isinstance(records, Mapping):
        raise UserError(f"{where} is no Argoverse 2 vector map: expected mappings from ids to records")
    return list(records.items())


def line_type(mark: str) -> LineType:
    """Return the OpenLane-V2 type of an Argoverse 2 marking.

    The first word of a mixed marking decides; OpenLane-V2 documents no rule for them.
    """
    if mark in ("NONE", "UNKNOWN"):
        return LineType.NONE
    if mark.startswith(("DASH", "DOUBLE_DASH")):
        return LineType.DASHED
    if mark.startswith(("SOLID", "DOUBLE_SOLID")):
        return LineType.SOLID
    raise ValueError(f"unknown lane marking {mark}")


def _points(record: Any, name: str, where: str, least: int) -> np.ndarray:
    """Return the points (n, 3) of an entry, n >= `least`."""
    listed = items(record, name, where)
    rows = [[member(point, axis, f"{where}.{name}[{i}]") for axis in "xyz"] for i, point in enumerate(listed)]
    if any(isinstance(value, (str, bool)) for row in rows for value in row):
        raise UserError(f"{where}.{name} holds text: coordinates are numbers")
    points = numbers(rows, (None, 3), f"{where}.{name}")
    if len(points) < least:
        raise UserError(f"{where}.{name} has {len(points)} points, expected at least {least}")
    check_steps(points, f"{where}.{name}")
    return points


def _lane_segment(record: Any, where: str) -> LaneSegment:
    left, right = (_points(record, f"{side}_lane_boundary", where, 2) for side in ("left", "right"))
    number = whole_number(member(record, "id", where), 0, _LARGEST_ID, f"{where}.id")
    successors = tuple(
        whole_number(other, 0, _LARGEST_ID, f"{where}.successors") for other in items(record, "successors", where)
    )
    if number in successors:
        raise UserError(f"{where} is its own successor: download it again")
    sides = resample(left, _CENTERLINE_POINTS), resample(right, _CENTERLINE_POINTS)
    if area_between(*sides) < 0.0:
        raise UserError(f"{where}: the left boundary is to the right of the right one, in driving direction")
    flags = member(record, "is_intersection", where), member(record, "lane_type", where)
    if not isinstance(flags[0], bool) or not isinstance(flags[1], str):
        raise UserError(f"{where}: is_intersection is true or false and lane_type is text, not {flags}")
    return LaneSegment(
        id=number,
        centerline=(sides[0] + sides[1]) / 2,
        left=left,
        right=right,
        left_type=_mark(record, "left_lane_mark_type", where),
        right_type=_mark(record, "right_lane_mark_type", where),
        is_intersection=flags[0],
        successors=successors,
        vehicle=flags[1] != "BIKE",
    )


def _mark(record: Any, name: str, where: str) -> LineType:
    mark = member(record, name, where)
    try:
        return line_type(str(mark))
    except ValueError:
        raise UserError(f"{where}.{name} is {mark!r:.40}, no lane marking of Argoverse 2") from None


def _crossing(record: Any, where: str) -> np.ndarray:
    """Return the ring of a crossing: its four corners, the ends of its edges, for edges of more than two points too."""
    (a, b), (c, d) = (_points(record, edge, where, 2)[[0, -1]] for edge in ("edge1", "edge2"))
    ring = np.stack([a, b, d, c, a])
    check_steps(ring, where)
    return ring


def _boundaries(areas: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return the closed rings of the union of drivable areas, each point at the height of the nearest map vertex."""
    from scipy.spatial import KDTree

    shapely = import_shapely("reading Argoverse 2")
    if not areas:
        return ()
    # A zero buffer repairs rings that touch themselves.
    union = shapely.union_all([shapely.Polygon(a[:, :2]).buffer(0) for a in areas])
    rings = [ring for part in shapely.get_parts(union) for ring in flat_rings(part)]
    vertices = np.concatenate(areas)
    nearest = KDTree(vertices[:, :2])
    return tuple(np.column_stack([ring, vertices[nearest.query(ring)[1], 2]]) for ring in rings)
