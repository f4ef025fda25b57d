"""Lanes of a place as GeoJSON (WGS84), so that any map can become a world: one feature for each lane.

| feature | properties |
|---|---|
| LineString, centerline in driving direction | `lane`: its id, a number or a text |
| | `successors`: ids, default: the lanes that start where this one ends |
| | `width`: metres, default 3.5 |
| | `left`, `right`: marking, "solid", "dashed" or "none" (default) |
| | `intersection`, `bicycle`: true or false (default) |
| | `traffic`: side on which it keeps, "left" or "right"; it counts where no lanes are oncoming (default right) |
| LineString or Polygon, edge of the drivable area | `boundary`: true |
| Polygon of four corners, the first two along the walk | `crossing`: true |

Other features are ignored, and so are properties that are null: exports of a table fill in what a feature does not
have. A geometry of type Multi... counts as its only part, 1 and 0 as true and false. A roundabout is several lanes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.geojson import Origin, line_coordinates, read_features, to_ego
from tflane_jax.datasets.lane_outlines import HALF_WIDTH, LaneOutline, boundaries
from tflane_jax.datasets.plausible import check_steps
from tflane_jax.errors import UserError
from tflane_jax.files.fields import as_list
from tflane_jax.files.wording import shown
from tflane_jax.geometry import without_repeats
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment, Side, VectorMap
from tflane_jax.world.roads.map_roadside import lane_points
from tflane_jax.world.roads.road_map import RoadMap

# Lanes that end and start nearer to each other than this continue one another, metres.
_SAME_END = 0.3
# Depth of the lists of coordinates.
_DEPTHS = {"LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3}
_MARKINGS = {"none": LineType.NONE, "solid": LineType.SOLID, "dashed": LineType.DASHED}
# A place of an example lies this far inside the hull of all lanes, or as far as the map allows, but at least the
# second, metres.
_INSIDE, _LEAST_INSIDE = 60.0, 30.0


class _Lane(NamedTuple):
    """A lane as its feature describes it.

    Attributes:
        line: centerline, degrees as read, later metres.
        properties: those that are not null.
        name: of the feature, for messages.
    """

    line: Float[np.ndarray, "n 2"]
    properties: Mapping[str, Any]
    name: str


def read_lanes(path: Path) -> RoadMap:
    """Read a map; its frame is x east, y north, in metres from the middle of its lanes.

    Raises UserError, which names file and feature, for a file that is no GeoJSON in WGS84, holds no lane, a lane twice,
    a property of another type, or a map too small to drive on.
    """
    path = Path(path)
    lanes: dict[str, _Lane] = {}
    border, crossings = [], []
    for name, feature in read_features(path):
        geometry, properties = _record(feature, "geometry", name), _record(feature, "properties", name)
        kind = str(geometry.get("type"))
        given = {key: value for key, value in properties.items() if value is not None}
        # True and 1 count. OpenStreetMap's own tags, such as crossing=zebra, are texts and do not.
        is_edge, is_crossing = given.get("boundary") == 1, given.get("crossing") == 1
        if not (is_edge or is_crossing or given.keys() & {"lane", "successors"}):
            continue
        if kind == "GeometryCollection":
            raise UserError(f"{name} is a GeometryCollection: give each of its lines a feature of its own")
        if kind not in _DEPTHS:
            continue
        lines = _lines(geometry, kind, name)
        if "lane" in given or not (is_edge or is_crossing):
            lane_id = _identity(given.get("lane"), name)
            if "LineString" not in kind or len(lines) != 1:
                raise UserError(f"{name}: lane {lane_id} is a {kind} of {len(lines)} lines: a lane is one LineString")
            if lane_id in lanes:
                raise UserError(f"{name} has the lane id {lane_id} of an earlier feature: give it another one")
            lanes[lane_id] = _Lane(lines[0], given, name)
        elif is_edge:
            border += [(line, name) for line in lines]
        elif "Polygon" not in kind or len(lines) != 1 or len(lines[0]) != 5:
            raise UserError(f"{name}: a crossing is a Polygon of four corners, the first two along the walk")
        else:
            crossings.append((lines[0], name))
    if not lanes:
        raise UserError(f"{path} holds no lane: a lane is a LineString with the property `lane`, its id")
    sides: set[Side] = {_side(lane.properties, lane.name) for lane in lanes.values() if "traffic" in lane.properties}
    if len(sides) > 1:
        raise UserError(f"{path}: traffic keeps to the left on some lanes and to the right on others: choose one side")
    degrees = np.concatenate([lane.line for lane in lanes.values()])
    if np.ptp(degrees[:, 0]) > 180.0:  # the map spans the 180th meridian
        degrees[:, 0] %= 360.0
    middle = degrees.mean(0)
    longitude = (float(middle[0]) + 180.0) % 360.0 - 180.0
    origin = Origin(latitude=float(middle[1]), longitude=longitude, heading=90.0)
    segments = _segments(
        {lane_id: lane._replace(line=_metres(lane.line, origin, lane.name)) for lane_id, lane in lanes.items()}
    )
    places, complete = _places(segments, path)
    flat = [tuple(_flat(_metres(line, origin, name)) for line, name in lines) for lines in (crossings, border)]
    whole = VectorMap(segments, flat[0], flat[1], side=next(iter(sides), None))
    return RoadMap(path.stem, "geojson", whole, places, complete)


def _record(feature: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    """Return geometry or properties of a feature; nothing where they are null."""
    value = feature.get(name) or {}
    if not isinstance(value, dict):
        raise UserError(f"{where}: {name} is {shown(value)}, expected a mapping: export the file again")
    return value


def _lines(geometry: Mapping[str, Any], kind: str, name: str) -> list[np.ndarray]:
    """Return the lines or rings of a geometry of any type in `_DEPTHS`, degrees."""
    coordinates = geometry.get("coordinates")
    parts = as_list(coordinates, f"{name}: coordinates") if _DEPTHS[kind] == 3 else [coordinates]
    return [line for part in parts for line in line_coordinates(part, min(_DEPTHS[kind], 2), name)]


def _metres(line: Float[np.ndarray, "n 2"], origin: Origin, name: str) -> Float[np.ndarray, "n 2"]:
    line = to_ego(line, origin)
    check_steps(line, name)
    return line


def _identity(value: Any, name: str) -> str:
    """Return an id as text; that of a table with empty cells may be a whole number in floating point."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, (int, str)):
        raise UserError(f"{name}: lane is {value!r:.40}, expected an id, a number or a text")
    return str(value)


def _segments(lanes: Mapping[str, _Lane]) -> dict[int, LaneSegment]:
    """Return the segment of each lane, whose line is in metres, by the lane's number in the file."""
    number = {lane_id: i for i, lane_id in enumerate(lanes)}
    lines = {number[lane_id]: _clean(lane.line, lane.name) for lane_id, lane in lanes.items()}
    starts, ends = (np.stack([line[i] for line in lines.values()]) for i in (0, -1))
    touching = np.linalg.norm(ends[:, None] - starts, axis=-1) < _SAME_END
    np.fill_diagonal(touching, False)
    after: dict[int, tuple[int, ...]] = {}
    for lane_id, (_, properties, name) in lanes.items():
        i = number[lane_id]
        after[i] = tuple(np.flatnonzero(touching[i]).tolist())
        if "successors" in properties:
            listed = properties["successors"]
            if not isinstance(listed, list):
                raise UserError(f"{name}: successors is {listed!r:.40}, expected a list of lane ids")
            wanted = [_identity(value, name) for value in listed]
            if unknown := set(wanted) - set(number):
                raise UserError(f"{name}: successor {min(unknown)} is no lane of this file")
            after[i] = tuple(dict.fromkeys(number[value] for value in wanted if value != lane_id))
    sides = boundaries({i: LaneOutline(line, None) for i, line in lines.items()}, {})
    segments = {}
    for lane_id, (_, properties, name) in lanes.items():
        i = number[lane_id]
        wider = _width(properties, name) / (2.0 * HALF_WIDTH)
        left, right = (lines[i] + wider * (side - lines[i]) for side in sides[i])
        segments[i] = LaneSegment(
            id=i,
            centerline=_flat(lines[i]),
            left=_flat(left),
            right=_flat(right),
            left_type=_marking(properties, "left", name),
            right_type=_marking(properties, "right", name),
            is_intersection=_flag(properties, "intersection", name),
            successors=after[i],
            vehicle=not _flag(properties, "bicycle", name),
        )
    return segments


def _clean(line: Float[np.ndarray, "n 2"], name: str) -> Float[np.ndarray, "m 2"]:
    """Return a line without points that repeat the one before."""
    line = without_repeats(line, 1e-3)
    if len(line) < 2:
        raise UserError(f"{name} is a lane without length: take it out")
    return line


def _width(properties: Mapping[str, Any], name: str) -> float:
    width = properties.get("width", 2.0 * HALF_WIDTH)
    if isinstance(width, bool) or not isinstance(width, (int, float)) or not 1.0 <= width <= 10.0:
        raise UserError(f"{name}: width is {width!r:.40}, expected metres between 1 and 10")
    return float(width)


def _flag(properties: Mapping[str, Any], flag: str, name: str) -> bool:
    value = properties.get(flag, False)
    if value not in (True, False):  # which 1 and 0 equal
        raise UserError(f"{name}: {flag} is {value!r:.40}, expected true or false")
    return bool(value)


def _marking(properties: Mapping[str, Any], side: str, name: str) -> LineType:
    marking = properties.get(side, "none")
    if not isinstance(marking, str) or marking not in _MARKINGS:
        raise UserError(f"{name}: {side} is {marking!r:.40}, expected one of {', '.join(_MARKINGS)}")
    return _MARKINGS[marking]


def _side(properties: Mapping[str, Any], name: str) -> Side:
    for side in ("left", "right"):
        if properties["traffic"] == side:
            return side
    raise UserError(f"{name}: traffic is {properties['traffic']!r:.40}, expected left or right")


def _flat(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    return np.pad(line, ((0, 0), (0, 1)))


def _places(segments: Mapping[int, LaneSegment], path: Path) -> tuple[Float[np.ndarray, "p 2"], float]:
    """Return the points of lanes well inside the map, and how far the map reaches around each of them, metres."""
    from scipy.spatial import ConvexHull, QhullError

    points = lane_points(s for s in segments.values() if s.vehicle)
    outline = np.concatenate([line[:, :2] for s in segments.values() for line in (s.left, s.right)])
    inside = np.zeros(len(points))
    try:
        hull = ConvexHull(outline)
        inside = -(points @ hull.equations[:, :2].T + hull.equations[:, 2]).max(1)
    except QhullError:  # all in one line
        pass
    reach = min(float(inside.max(initial=0.0)), _INSIDE)
    if reach < _LEAST_INSIDE:
        raise UserError(
            f"{path} is too small a map: no lane open to motor vehicles is {_LEAST_INSIDE:.0f} m inside the area of "
            f"all lanes (the most is {reach:.0f} m). Add the lanes around it"
        )
    return points[inside >= 0.9 * reach], reach
