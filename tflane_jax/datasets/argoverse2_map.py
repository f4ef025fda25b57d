"""The vector map of an Argoverse 2 sensor log: `map/log_map_archive_*.json` -> `VectorMap`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tflane_jax.errors import UserError
from tflane_jax.geometry.polylines import resample
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment, VectorMap

MAP_PATTERN = "log_map_archive_*.json"
# Argoverse 2's own API makes centerlines of ten points.
_CENTERLINE_POINTS = 10


def read_map(folder: Path) -> VectorMap:
    """Read the map file in `folder`; raise UserError if it is missing or damaged."""
    path = find_map(folder)
    if path is None:
        raise UserError(f"{folder} holds no {MAP_PATTERN}: download the log's map folder")
    try:
        archive = json.loads(path.read_text())
        segments = {s.id: s for s in map(_lane_segment, archive["lane_segments"].values())}
        crossings = tuple(_crossing(c) for c in archive["pedestrian_crossings"].values())
        areas = [_points(a["area_boundary"]) for a in archive["drivable_areas"].values()]
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not valid json ({error}): download it again") from error
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise UserError(f"{path} is not an Argoverse 2 vector map ({error!r}): download it again") from error
    return VectorMap(segments=segments, crossings=crossings, road_boundaries=_boundaries(areas))


def find_map(folder: Path) -> Path | None:
    """Return the map json in a map folder, or None."""
    return next(iter(sorted(folder.glob(MAP_PATTERN))), None)


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


def _points(points: list[dict[str, float]]) -> np.ndarray:
    return np.array([[p["x"], p["y"], p["z"]] for p in points], np.float64).reshape(-1, 3)


def _lane_segment(record: dict[str, Any]) -> LaneSegment:
    left, right = _points(record["left_lane_boundary"]), _points(record["right_lane_boundary"])
    return LaneSegment(
        id=int(record["id"]),
        centerline=(resample(left, _CENTERLINE_POINTS) + resample(right, _CENTERLINE_POINTS)) / 2,
        left=left,
        right=right,
        left_type=line_type(record["left_lane_mark_type"]),
        right_type=line_type(record["right_lane_mark_type"]),
        is_intersection=bool(record["is_intersection"]),
        successors=tuple(int(s) for s in record["successors"]),
        vehicle=record["lane_type"] != "BIKE",
    )


def _crossing(record: dict[str, Any]) -> np.ndarray:
    (a, b), (c, d) = _points(record["edge1"]), _points(record["edge2"])
    return np.stack([a, b, d, c, a])


def _boundaries(areas: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return the closed rings of the union of drivable areas, each point at the height of the nearest map vertex."""
    try:
        import shapely
        from scipy.spatial import KDTree
    except ImportError as error:
        raise UserError("reading Argoverse 2 needs shapely: pip install 'tflane_jax[data]'") from error
    if not areas:
        return ()
    # A zero buffer repairs rings that touch themselves.
    union = shapely.union_all([shapely.Polygon(a[:, :2]).buffer(0) for a in areas])
    rings = [ring for part in shapely.get_parts(union) for ring in (part.exterior, *part.interiors)]
    vertices = np.concatenate(areas)
    nearest = KDTree(vertices[:, :2])
    flat = [np.asarray(ring.coords)[:, :2] for ring in rings]
    return tuple(np.column_stack([ring, vertices[nearest.query(ring)[1], 2]]) for ring in flat)
