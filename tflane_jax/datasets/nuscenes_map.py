"""The map expansion of nuScenes (`maps/expansion/<location>.json`, version 1.3 or later) -> `VectorMap`.

The file holds a whole city in flat coordinates, which are nuScenes' global ones. Traps: a polygon may be null, that of
a lane connector is only a box around it (https://github.com/nutonomy/nuscenes-devkit/issues/915), a lane may lack its
arcline, and `connectivity` names lanes that the file does not have. The rules of the lines are MapTR's: dividers are
the records of `road_divider` and `lane_divider`, boundaries the border of the union of road segments and lanes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.lane_outlines import LaneOutline, boundaries
from tflane_jax.datasets.nuscenes_arclines import lane_points
from tflane_jax.datasets.plausible import check_steps
from tflane_jax.datasets.shapely_polygons import flat_rings, import_shapely
from tflane_jax.errors import UserError
from tflane_jax.files.fields import items, load_json, member, numbers
from tflane_jax.scene import LineType
from tflane_jax.scene.logs import LaneSegment, VectorMap

# MapTRv2 discretises center lines at half a metre.
RESOLUTION = 0.5
# Older files lack arclines.
_FIRST_VERSION = (1, 3)
# What needs shapely, for the message where it is not installed.
_PURPOSE = "reading nuScenes maps"

Polygon = tuple[np.ndarray, ...]
"""Rings (n, 2) that repeat their first point, the exterior first."""


@dataclass(frozen=True)
class ExpansionLane:
    """A record of `lane` or `lane_connector`.

    Attributes:
        token: of the record.
        centerline: (n, 2) at `RESOLUTION`.
        polygon: None where the file has none, and of connectors, whose polygons are boxes around them.
        connector: through an intersection (`lane_connector`).
        vehicle: open to motor vehicles.
        left_type, right_type: the most frequent marking along each side.
        successors: numbers of the lanes that continue it.
    """

    token: str
    centerline: np.ndarray
    polygon: Polygon | None
    connector: bool
    vehicle: bool
    left_type: LineType
    right_type: LineType
    successors: tuple[int, ...]


@dataclass(frozen=True)
class MapExpansion:
    """The map of a city, global metres.

    Attributes:
        location: such as boston-seaport.
        lanes: by number, which is the id of the lane in every `VectorMap` of this city.
        dividers: lines (n, 2).
        crossings: polygons.
        roads: polygons of road segments and lanes.
        without_line: tokens of the lanes left out because they have no arcline.
    """

    location: str
    lanes: Mapping[int, ExpansionLane]
    dividers: tuple[np.ndarray, ...]
    crossings: tuple[Polygon, ...]
    roads: tuple[Polygon, ...]
    without_line: tuple[str, ...]

    @cached_property
    def _boxes(self) -> Mapping[str, Float[np.ndarray, "n 2 2"]]:
        """Bounding boxes of all elements, because every scene asks which are near."""
        return {
            "lanes": _bounds([lane.centerline for lane in self.lanes.values()]),
            "dividers": _bounds(self.dividers),
            "crossings": _bounds([polygon[0] for polygon in self.crossings]),
            "roads": _bounds([polygon[0] for polygon in self.roads]),
        }

    def _near(self, name: str, path: np.ndarray, reach: float) -> list[Any]:
        """Return the elements whose bounding box comes within `reach` of a path."""
        low, high = self._boxes[name][:, None, 0], self._boxes[name][:, None, 1]
        outside = np.maximum(np.maximum(low - path, path - high), 0.0)
        near = (np.linalg.norm(outside, axis=-1) <= reach).any(-1)
        elements = self.lanes.items() if name == "lanes" else getattr(self, name)
        return [element for element, close in zip(elements, near, strict=True) if close]

    def lanes_near(self, path: Float[np.ndarray, "f 2"], reach: float) -> dict[int, ExpansionLane]:
        """Return the lanes whose bounding box comes within `reach` metres of a path."""
        return dict(self._near("lanes", path, reach))

    def around(self, path: Float[np.ndarray, "f 2"], reach: float) -> VectorMap:
        """Return the part of the map whose elements come near a path, each element whole; all heights are 0.

        Args:
            path: positions, global metres.
            reach: greatest distance of an element's bounding box from a position, metres.
        """
        kept = self.lanes_near(path, reach)
        outlines = {n: LaneOutline(x.centerline, None if x.polygon is None else x.polygon[0]) for n, x in kept.items()}
        sides = boundaries(outlines, {number: lane.successors for number, lane in kept.items()})
        return VectorMap(
            segments={number: _segment(number, lane, *sides[number]) for number, lane in kept.items()},
            crossings=tuple(flat(one[0]) for one in self._near("crossings", path, reach) if _shape(one).is_valid),
            road_boundaries=tuple(flat(ring) for ring in union_rings(self._near("roads", path, reach))),
            dividers=tuple(flat(line) for line in self._near("dividers", path, reach)),
        )


def read_expansion(path: Path) -> MapExpansion:
    """Read a map file.

    Raises:
        UserError: the file is missing, older than version 1.3, lacks a layer, or a record is malformed or names a node,
            line or polygon that does not exist; the message names the file, the layer and the token.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} is missing: download nuScenes' map expansion, version 1.3, into maps/")
    file = _MapFile(path)
    lanes, without = file.lanes()
    roads = [polygon for _, polygon in file.polygons("road_segment")]
    roads += [polygon for _, polygon in file.polygons("lane")]
    return MapExpansion(
        location=path.stem,
        lanes=lanes,
        dividers=tuple(line for layer in ("road_divider", "lane_divider") for line in file.lines(layer)),
        crossings=tuple(polygon for _, polygon in file.polygons("ped_crossing")),
        roads=tuple(roads),
        without_line=tuple(without),
    )


class _MapFile:
    """The content of a map file with its cross references."""

    def __init__(self, path: Path):
        self.path = path
        self.content = load_json(path)
        if isinstance(self.content, Mapping) and "version" not in self.content:
            raise UserError(
                f"{path} names no version, as the first ones do, which have no arclines: download version 1.3"
            )
        version = str(member(self.content, "version", str(path)))
        parts = version.split(".")
        if not all(part.isdecimal() and len(part) < 10 for part in parts) or tuple(map(int, parts)) < _FIRST_VERSION:
            raise UserError(f"{path} is version {version!r:.20}, which has no arclines: download version 1.3")
        nodes = self._layer("node")
        points = [[member(row, axis, f"{path}: node {token}") for axis in ("x", "y")] for token, row in nodes.items()]
        self.nodes = dict(zip(nodes, numbers(points, (len(points), 2), f"{path}: node").astype(float), strict=True))
        self.line_rows, self.polygon_rows = self._layer("line"), self._layer("polygon")

    def lines(self, layer: str) -> Iterator[np.ndarray]:
        """Yield the line of each record of a layer; those of fewer than two nodes are left out."""
        for token, row in self._layer(layer).items():
            where = self._where(layer, token)
            line = self._line(member(row, "line_token", where), where)
            if len(line) > 1:
                yield line

    def polygons(self, layer: str) -> Iterator[tuple[str, Polygon]]:
        """Yield token and polygon of each record of a layer that has one; polygons of no area are left out."""
        for token, row in self._layer(layer).items():
            where = self._where(layer, token)
            polygon = self._polygon(member(row, "polygon_token", where), where)
            if polygon is not None:
                yield token, polygon

    def lanes(self) -> tuple[dict[int, ExpansionLane], list[str]]:
        """Return lanes and connectors by number, and the tokens of those without an arcline."""
        rows = {layer: self._layer(layer) for layer in ("lane", "lane_connector")}
        if repeated := set(rows["lane"]) & set(rows["lane_connector"]):
            raise UserError(f"{self.path}: {min(repeated)} is both a lane and a lane_connector")
        arclines = self._dict("arcline_path_3")
        lines: dict[str, np.ndarray] = {}
        for token in sorted([*rows["lane"], *rows["lane_connector"]]):
            where = self._where("arcline_path_3", token)
            if arclines.get(token):
                lines[token] = lane_points(items(arclines, token, where), RESOLUTION, where)
        number = {token: i for i, token in enumerate(token for token, line in lines.items() if len(line) > 1)}
        after = self._successors(number)
        found = {i: self._lane(token, rows, lines[token], tuple(sorted(after[i]))) for token, i in number.items()}
        return found, [token for layer in rows.values() for token in layer if token not in number]

    def _lane(
        self, token: str, rows: Mapping[str, Mapping[str, Any]], line: np.ndarray, successors: tuple[int, ...]
    ) -> ExpansionLane:
        layer = "lane" if token in rows["lane"] else "lane_connector"
        row, where = rows[layer][token], self._where(layer, token)
        return ExpansionLane(
            token=token,
            centerline=line,
            polygon=self._polygon(row.get("polygon_token"), where) if layer == "lane" else None,
            connector=layer == "lane_connector",
            vehicle=row.get("lane_type", "CAR") != "BIKE",
            left_type=_marking(row, "left_lane_divider_segments", where),
            right_type=_marking(row, "right_lane_divider_segments", where),
            successors=successors,
        )

    def _successors(self, number: Mapping[str, int]) -> dict[int, set[int]]:
        """Return the successors of each lane, from both ends of a connection, without itself and lanes of no record."""
        after: dict[int, set[int]] = {i: set() for i in number.values()}
        for token, row in self._dict("connectivity").items():
            where = self._where("connectivity", token)
            outgoing, incoming = (items(row, name, where) for name in ("outgoing", "incoming"))
            if wrong := [other for other in (*outgoing, *incoming) if not isinstance(other, str)]:
                raise UserError(f"{where}: {wrong[0]!r:.40} is no token of a lane")
            pairs = [*((token, other) for other in outgoing), *((other, token) for other in incoming)]
            for first, second in pairs:
                if first in number and second in number and first != second:
                    after[number[first]].add(number[second])
        return after

    def _layer(self, name: str) -> dict[str, Mapping[str, Any]]:
        """Return the rows of a layer by token."""
        found: dict[str, Mapping[str, Any]] = {}
        for row in items(self.content, name, str(self.path)):
            token = member(row, "token", f"{self.path}: a row of {name}")
            if not isinstance(token, str) or token in found:
                raise UserError(f"{self.path}: {name}: the token {token!r:.60} is no text, or two rows have it")
            found[token] = row
        return found

    def _dict(self, name: str) -> Mapping[str, Any]:
        value = member(self.content, name, str(self.path))
        if not isinstance(value, Mapping):
            raise UserError(f"{self.path}: {name} is of type {type(value).__name__}, expected a mapping from lanes")
        return value

    def _where(self, layer: str, token: str) -> str:
        return f"{self.path}: {layer} {token}"

    def _points(self, tokens: Sequence[Any], where: str) -> np.ndarray:
        for token in tokens:
            if not isinstance(token, str) or token not in self.nodes:
                raise UserError(f"{where}: the node {token!r:.60} is not in the file")
        points = np.array([self.nodes[token] for token in tokens], float).reshape(-1, 2)
        check_steps(points, where)
        return points

    def _line(self, token: Any, where: str) -> np.ndarray:
        if not isinstance(token, str) or token not in self.line_rows:
            raise UserError(f"{where}: the line {token!r:.60} is not in the file")
        place = self._where("line", token)
        return self._points(items(self.line_rows[token], "node_tokens", place), place)

    def _polygon(self, token: Any, where: str) -> Polygon | None:
        """Return a polygon; None for a null token and for rings of fewer than three nodes."""
        if token is None or token == "":
            return None
        if not isinstance(token, str) or token not in self.polygon_rows:
            raise UserError(f"{where}: the polygon {token!r:.60} is not in the file")
        row, place = self.polygon_rows[token], self._where("polygon", token)
        holes = items(row, "holes", place) if "holes" in row else ()
        rings = [items(row, "exterior_node_tokens", place), *(items(hole, "node_tokens", place) for hole in holes)]
        points = [self._points(ring, place) for ring in rings]
        if len(points[0]) < 3:
            return None
        return tuple(closed(ring) for ring in points if len(ring) > 2)


def closed(ring: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "m d"]:
    """Return a ring that repeats its first point."""
    return ring if np.array_equal(ring[0], ring[-1]) else np.concatenate([ring, ring[:1]])


def flat(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Return a line at height 0."""
    return np.column_stack([line, np.zeros(len(line))])


def union_rings(polygons: Sequence[Polygon]) -> list[np.ndarray]:
    """Return the rings of the union of polygons: exteriors clockwise, interiors counter-clockwise, as in MapTR.

    Polygons that cross themselves are left out, as there. Raises UserError if shapely is not installed.
    """
    parts = [_shape(polygon) for polygon in polygons]
    if not parts:
        return []
    from shapely.geometry.polygon import orient

    shapely = import_shapely(_PURPOSE)
    union = shapely.union_all([part for part in parts if part.is_valid])
    rings = []
    for part in shapely.get_parts(union):
        if part.geom_type == "Polygon" and not part.is_empty:
            rings += flat_rings(orient(part, -1.0))
    return rings


def _shape(polygon: Polygon) -> Any:
    """Return a polygon of shapely; raises UserError if shapely is not installed."""
    return import_shapely(_PURPOSE).Polygon(polygon[0], polygon[1:])


def _segment(number: int, lane: ExpansionLane, left: np.ndarray, right: np.ndarray) -> LaneSegment:
    return LaneSegment(
        id=number,
        centerline=flat(lane.centerline),
        left=flat(left),
        right=flat(right),
        left_type=lane.left_type,
        right_type=lane.right_type,
        is_intersection=lane.connector,
        successors=lane.successors,
        vehicle=lane.vehicle,
    )


def _marking(row: Mapping[str, Any], name: str, where: str) -> LineType:
    """Return the most frequent marking of one side of a lane; connectors have none."""
    if name not in row:
        return LineType.NONE
    marks = [member(segment, "segment_type", f"{where}: {name}") for segment in items(row, name, where)]
    types = [_line_type(mark, f"{where}: {name}") for mark in marks]
    return max(LineType, key=types.count) if types else LineType.NONE


def _line_type(mark: Any, where: str) -> LineType:
    if not isinstance(mark, str):
        raise UserError(f"{where}: segment_type is {mark!r:.40}, expected text")
    words = mark.split("_")
    if "DASHED" in words:
        return LineType.DASHED
    return LineType.SOLID if "SOLID" in words or "ZIGZAG" in words else LineType.NONE


def _bounds(lines: Sequence[np.ndarray]) -> Float[np.ndarray, "n 2 2"]:
    """Return the lowest and highest x and y of each line."""
    return np.array([[line.min(0), line.max(0)] for line in lines]).reshape(-1, 2, 2)
