"""Lines of a whole map and their pieces in a patch around the vehicle: the rules of MapTR's ground truth.

MapTR takes them from nuScenes: dividers each on its own; pedestrian crossings that touch merged, then cut; the border
of the union of all road areas, cut inside the patch, so that the patch's own border is never a boundary; and, in
MapTRv2, centerlines as all simple paths from a root to a leaf of the lane graph inside the patch.

Plain geometry: `MapGeometry.of` takes polylines and polygons of any source, global metres.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.datasets.packed_lines import PackedLines
from tflane_jax.datasets.shapely_polygons import flat_rings, import_shapely
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.polylines import clip_to_range, simplify, without_repeats
from tflane_jax.geometry.rings import from_first_corner, oriented
from tflane_jax.scene import LineClass

# Metres. MapTR cuts road boundaries this far inside the patch; figures of OpenLane-V2 agree with it.
BOUNDARY_MARGIN = 0.2
# Metres; MapTRv2 simplifies centerlines by at most this much (Douglas and Peucker).
SIMPLIFIED = 0.2
# Metres; ends of lines that are nearer than this are one point.
SAME_END = 0.1
# Paths through the lanes of a patch; forks and merges in succession double them.
_MOST_PATHS = 10_000

Polygon = Sequence[Float[np.ndarray, "_ d"]]
"""A polygon: the exterior ring, then the interior ones; each repeats its first point."""


@dataclass(frozen=True)
class MapPiece:
    """A line of a map inside a patch.

    Attributes:
        points: (n, 3) metres, in the frame of the patch; a ring repeats its first point.
        category: `LineClass`.
        number: of the map's line of this class that it is a piece of; None for centerlines, whose paths change with
            the patch.
    """

    points: np.ndarray
    category: LineClass
    number: int | None

    @property
    def closed(self) -> bool:
        """Whether it is a ring."""
        return len(self.points) > 2 and bool(np.array_equal(self.points[0], self.points[-1]))


@dataclass(frozen=True)
class MapGeometry:
    """The lines of a whole map, global metres, ready to be cut.

    Attributes:
        dividers: one line for each divider.
        crossings: the rings of merged crossings, those of a polygon in succession: its exterior first and clockwise,
            then its interiors, counter-clockwise.
        polygon: (R,) number of the polygon that each ring of `crossings` belongs to.
        boundaries: lines and rings.
        centerlines: lanes in driving direction.
        edges: (E, 2) lane numbers; the second continues the first.
    """

    dividers: PackedLines
    crossings: PackedLines
    polygon: Int[np.ndarray, " r"]
    boundaries: PackedLines
    centerlines: PackedLines
    edges: Int[np.ndarray, "e 2"]

    @classmethod
    def of(
        cls,
        *,
        dividers: Sequence[np.ndarray] = (),
        crossings: Sequence[Polygon] = (),
        roads: Sequence[Polygon] = (),
        boundaries: Sequence[np.ndarray] = (),
        centerlines: Sequence[np.ndarray] = (),
        edges: Int[np.ndarray, "e 2"] | None = None,
    ) -> MapGeometry:
        """Merge and pack the elements of a map.

        Args:
            dividers: polylines (n, 3).
            crossings: polygons; those that touch are merged.
            roads: polygons; the border of their union is a boundary.
            boundaries: further boundaries, polylines and rings; those that share an end are joined.
            centerlines: polylines (n, 3) in driving direction.
            edges: lane numbers; the second continues the first.

        Raises:
            UserError: areas must be merged, and shapely is not installed.
        """
        merged = merge_polygons(crossings)
        borders = [ring for polygon in merge_polygons(roads) for ring in polygon]
        return cls(
            dividers=PackedLines.pack(list(dividers)),
            crossings=PackedLines.pack([ring for polygon in merged for ring in polygon]),
            polygon=np.repeat(np.arange(len(merged)), [len(polygon) for polygon in merged]),
            boundaries=PackedLines.pack([*borders, *join_ends(boundaries)]),
            centerlines=PackedLines.pack(list(centerlines)),
            edges=np.zeros((0, 2), int) if edges is None else edges,
        )

    def cut(
        self, patch_from_global: Float[np.ndarray, "4 4"], patch: PerceptionRange, *, centerlines: bool
    ) -> list[MapPiece]:
        """Return the pieces inside a patch, in its frame: dividers, crossings, boundaries, and centerlines if wanted.

        Rings start at their first corner (`geometry.rings`), wherever the map has them start. Raises UserError where a
        crossing must be cut and shapely is not installed, and as `lane_paths`.
        """
        pieces = [
            MapPiece(piece, LineClass.DIVIDER, number)
            for number, line in _near(self.dividers, patch_from_global, patch)
            for piece in clip_ring(line, patch)
        ]
        polygons: dict[int, list[np.ndarray]] = {}
        for ring, line in _near(self.crossings, patch_from_global, patch):
            polygons.setdefault(int(self.polygon[ring]), []).append(line)
        pieces += [
            MapPiece(ring, LineClass.CROSSING, number)
            for number, rings in polygons.items()
            for ring in cut_polygon(rings, patch)
        ]
        inner = shrunken(patch, BOUNDARY_MARGIN)
        pieces += [
            MapPiece(piece, LineClass.BOUNDARY, number)
            for number, line in _near(self.boundaries, patch_from_global, inner)
            for piece in clip_ring(line, inner)
        ]
        if centerlines:
            lanes = dict(_near(self.centerlines, patch_from_global, patch))
            edges = [(int(a), int(b)) for a, b in self.edges if a in lanes and b in lanes]
            pieces += [MapPiece(path, LineClass.CENTERLINE, None) for path in lane_paths(lanes, edges, patch)]
        return [replace(p, points=from_first_corner(p.points)) if p.closed else p for p in pieces]


def _near(lines: PackedLines, pose: np.ndarray, range_: PerceptionRange) -> Iterator[tuple[int, np.ndarray]]:
    """Yield number and points, in the frame of the range, of the lines whose bounding box meets it."""
    moved = lines.moved(pose)
    for number in moved.near(range_):
        yield number, moved.line(number)


def shrunken(range_: PerceptionRange, margin: float) -> PerceptionRange:
    """Return the range less a margin, metres, on all four sides."""
    (x0, x1), (y0, y1) = range_.x, range_.y
    return PerceptionRange((x0 + margin, x1 - margin), (y0 + margin, y1 - margin), range_.z)


def clip_ring(line: np.ndarray, range_: PerceptionRange) -> list[np.ndarray]:
    """Cut a line at the range. The pieces of a closed ring are joined again where its first point lies in the range."""
    pieces = clip_to_range(line, range_)
    closed = np.array_equal(line[0], line[-1])
    if closed and len(pieces) > 1 and all(np.array_equal(p, line[0]) for p in (pieces[0][0], pieces[-1][-1])):
        pieces = [np.concatenate([pieces[-1], pieces[0][1:]]), *pieces[1:-1]]
    return pieces


def cut_polygon(rings: Polygon, patch: PerceptionRange) -> list[np.ndarray]:
    """Return the rings of the part of a polygon inside a patch; they run along the patch's border where it is cut.

    Exteriors run clockwise, interiors counter-clockwise; if nothing is cut, the rings are returned as they are.
    """
    if all(patch.contains(ring).all() for ring in rings):
        return list(rings)
    shapely = _shapely()
    (x0, x1), (y0, y1) = patch.x, patch.y
    return [ring for part in _parts(_polygon(rings) & shapely.box(x0, y0, x1, y1), rings) for ring in part]


def merge_polygons(polygons: Sequence[Polygon]) -> list[list[np.ndarray]]:
    """Return the union of polygons, as polygons that do not touch; heights are those of the nearest vertices.

    Exteriors run clockwise, interiors counter-clockwise, as in MapTR. Polygons whose bounding boxes do not meet any
    other keep their vertices. Raises UserError if shapely is needed and not installed.
    """
    low = np.array([np.min(p[0][:, :2], 0) for p in polygons]).reshape(-1, 2)
    high = np.array([np.max(p[0][:, :2], 0) for p in polygons]).reshape(-1, 2)
    meets = ((low[:, None] <= high) & (low <= high[:, None])).all(-1).sum(1) > 1
    apart = [oriented(p) for p, meeting in zip(polygons, meets, strict=True) if not meeting]
    together = [p for p, meeting in zip(polygons, meets, strict=True) if meeting]
    if not together:
        return apart
    union = _shapely().union_all([_polygon(p) for p in together])
    return apart + _parts(union, [ring for p in together for ring in p])


def _polygon(rings: Polygon) -> Any:
    # A zero buffer repairs rings that touch themselves.
    return _shapely().Polygon(rings[0][:, :2], [ring[:, :2] for ring in rings[1:]]).buffer(0)


def _parts(geometry: Any, near: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
    """Return the polygons of a geometry as rings, each point at the height of the nearest vertex of lines."""
    from scipy.spatial import KDTree
    from shapely.geometry.polygon import orient

    vertices = np.concatenate(near)
    nearest = KDTree(vertices[:, :2])
    found = []
    for part in _shapely().get_parts(geometry):
        if part.geom_type == "Polygon" and part.area > 0.0:
            rings = flat_rings(orient(part, -1.0))
            found.append([np.column_stack([ring, vertices[nearest.query(ring)[1], 2]]) for ring in rings])
    return found


def _shapely() -> Any:
    return import_shapely("cutting the areas of a vector map")


def join_ends(lines: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Join lines end to end wherever exactly two ends meet, in either direction; a chain that comes back is a ring.

    Ends meet within `SAME_END` in the ground plane.

    Args:
        lines: polylines (n, 3), at least two points each.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if not lines:
        return []
    # End 2 i is the start of line i, end 2 i + 1 its last point: `end // 2` is the line, `end ^ 1` its other end.
    ends = np.concatenate([[line[0, :2], line[-1, :2]] for line in lines])
    pairs = KDTree(ends).query_pairs(SAME_END, output_type="ndarray")
    size = (len(ends), len(ends))
    node = connected_components(coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=size), directed=False)[1]
    partner: dict[int, int] = {}
    for pair in np.flatnonzero(np.bincount(node) == 2):
        first, second = np.flatnonzero(node == pair).tolist()
        partner |= {first: second, second: first}
    chains, used = [], set()
    # From the open ends first: the lines that remain are on rings.
    for start in [e for e in range(len(ends)) if e not in partner] + list(range(len(ends))):
        parts, end = [], start
        while end is not None and end // 2 not in used:
            used.add(end // 2)
            line = lines[end // 2]
            if end % 2:  # entered at its last point
                line = line[::-1]
            parts.append(line if not parts else line[1:])
            end = partner.get(end ^ 1)
        if parts:
            chain = np.concatenate(parts)
            if end == start:
                chain[-1] = chain[0]
            chains.append(chain)
    return chains


def lane_paths(
    lanes: dict[int, np.ndarray], edges: Sequence[tuple[int, int]], patch: PerceptionRange
) -> list[np.ndarray]:
    """Return all simple paths from a root to a leaf of the lane graph inside a patch, as simplified lines.

    A lane that the border cuts into several pieces is several nodes. Two lanes are joined if their joint lies inside.
    (MapTRv2 also joins the last piece of a lane to the first piece of its successor if the joint lies outside, by a
    straight line.) A cycle without a root gives no path. Raises UserError for more than 10,000 paths.

    Args:
        lanes: by number, in driving direction, frame of the patch.
        edges: lane numbers; the second continues the first.
        patch: the range.
    """
    nodes: list[np.ndarray] = []
    first: dict[int, int] = {}  # node that contains the start of a lane
    last: dict[int, int] = {}
    for number, lane in lanes.items():
        pieces = clip_to_range(lane, patch)
        if pieces and np.array_equal(pieces[0][0], lane[0]):
            first[number] = len(nodes)
        if pieces and np.array_equal(pieces[-1][-1], lane[-1]):
            last[number] = len(nodes) + len(pieces) - 1
        nodes += pieces
    following: dict[int, list[int]] = {node: [] for node in range(len(nodes))}
    for before, after in edges:
        if before in last and after in first:
            following[last[before]].append(first[after])
    roots = set(following) - {node for after in following.values() for node in after}
    paths = _simple_paths(sorted(roots), following)
    return [simplify(_concatenated([nodes[node] for node in path]), SIMPLIFIED) for path in paths]


def _simple_paths(roots: Sequence[int], following: dict[int, list[int]]) -> list[list[int]]:
    """Return every path from a root to a leaf that visits no node twice."""
    paths: list[list[int]] = []
    begun, tried = [[root] for root in reversed(roots)], 0
    while begun:
        path = begun.pop()
        after, tried = following[path[-1]], tried + 1
        if not after:
            paths.append(path)
        # Paths that come back to themselves end without a leaf.
        if len(paths) > _MOST_PATHS or tried > 10 * _MOST_PATHS:
            raise UserError(
                f"the lanes around the vehicle fork and merge to more than {_MOST_PATHS} paths: restore the map, or "
                "leave out centerlines (data.example.map_lines.centerlines = exclude)"
            )
        begun += [[*path, node] for node in reversed(after) if node not in path]
    return paths


def _concatenated(lines: Sequence[np.ndarray]) -> np.ndarray:
    """Return one line; a point that follows an equal one is left out."""
    return without_repeats(np.concatenate(lines), 0.0)
