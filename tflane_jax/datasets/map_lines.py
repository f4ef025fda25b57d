"""Lines of a vector map (MapTR's ground truth) from a map and an ego pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.datasets.map_geometry import MapGeometry
from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.polylines import nearest_lines, resample_lines
from tflane_jax.limits import Count, counted
from tflane_jax.scene import LineClass, MapLines
from tflane_jax.world.bev.line_of_sight import hidden_points

# Points on each line at which line of sight is tested.
_SIGHT_SAMPLES = 101
# Points at which MapTR's metric compares lines; `metrics.vector_map` asks for as many.
DENSE_POINTS = 100


@dataclass(frozen=True)
class MapLinesConfig:
    """Which lines of a vector map are ground truth; they are cut at `ExampleConfig.range`.

    Attributes:
        lines, points: lines of an example, and points on each, equally spaced.
        centerlines: "include" adds MapTRv2's fourth class to dividers, crossings and boundaries: every path through
            the lane graph inside the range.
    """

    lines: Count = 64
    points: Annotated[int, counted(2)] = 20
    centerlines: Literal["exclude", "include"] = "exclude"


def crop_map_lines(
    geometry: MapGeometry,
    ego_from_global: Float[np.ndarray, "4 4"],
    range_: PerceptionRange,
    config: MapLinesConfig,
    *,
    boxes: Float[np.ndarray, "k 7"],
    buildings: Float[np.ndarray, "b 5"],
) -> tuple[MapLines, int]:
    """Return the lines near the vehicle, ego frame, and how many of them (the farthest) exceeded the capacity.

    Args:
        geometry, ego_from_global, range_: map, pose, and perception range in the ego frame.
        config: classes and sizes.
        boxes, buildings: obstacles to the line of sight (see `hidden_points`), ego frame.
    """
    pieces = geometry.cut(ego_from_global, range_, centerlines=config.centerlines == "include")
    kept = nearest_lines([piece.points for piece in pieces], config.lines)
    dropped, pieces, n = len(pieces) - len(kept), [pieces[i] for i in kept], len(kept)
    lines = MapLines.empty(config.lines, config.points, DENSE_POINTS)
    if n:
        originals = [piece.points for piece in pieces]
        sight = resample_lines(originals, _SIGHT_SAMPLES)[..., :2]
        hidden = hidden_points(sight.reshape(-1, 2), boxes, buildings).reshape(n, -1)
        lines.points[:n] = resample_lines(originals, config.points)
        assert lines.dense is not None
        lines.dense[:n] = resample_lines(originals, DENSE_POINTS)
        lines.category[:n] = [piece.category for piece in pieces]
        lines.closed[:n] = [piece.closed for piece in pieces]
        lines.valid[:n] = True
        assert lines.visibility is not None
        lines.visibility[:n] = 1.0 - hidden.mean(-1)
        assert lines.identity is not None
        # Numbers of a class are told apart by their remainder.
        lines.identity[:n] = [0 if p.number is None else len(LineClass) * p.number + p.category for p in pieces]
    return lines, dropped
