"""The perception range around the vehicle and its bird's-eye-view grid."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float

from tflane_jax.geometry.namespace import ArrayT, constants
from tflane_jax.limits import Count, Interval


@dataclass(frozen=True)
class PerceptionRange:
    """Axis-aligned box around the vehicle, metres: R_p of TF-Lane (section 3.2).

    In the ego frame (x forward, y left); for a host that works in other axes, in these (`HostSpec`).

    Attributes:
        x, y, z: (low, high) of each axis, metres.
    """

    x: Interval = (-50.0, 50.0)
    y: Interval = (-25.0, 25.0)
    z: Interval = (-2.3, 1.7)

    def low(self, dims: int = 3) -> tuple[float, ...]:
        """Return the lower corner of the first `dims` axes, metres."""
        return tuple(axis[0] for axis in (self.x, self.y, self.z)[:dims])

    def size(self, dims: int = 3) -> tuple[float, ...]:
        """Return the extent of the first `dims` axes, metres."""
        return tuple(axis[1] - axis[0] for axis in (self.x, self.y, self.z)[:dims])

    def normalise(self, points: Float[ArrayT, "*b d"]) -> Float[ArrayT, "*b d"]:
        """Map metres to [0, 1] inside the box (d = 2 or 3)."""
        d = points.shape[-1]
        return (points - _like(points, self.low(d))) / _like(points, self.size(d))

    def denormalise(self, points: Float[ArrayT, "*b d"]) -> Float[ArrayT, "*b d"]:
        """Map [0, 1] inside the box to metres (d = 2 or 3)."""
        d = points.shape[-1]
        return _like(points, self.low(d)) + points * _like(points, self.size(d))

    def contains(self, points: Float[ArrayT, "*b d"]) -> Bool[ArrayT, "*b"]:
        """Return whether x and y lie inside the box, border included; z is ignored."""
        inside_x = (points[..., 0] >= self.x[0]) & (points[..., 0] <= self.x[1])
        return inside_x & (points[..., 1] >= self.y[0]) & (points[..., 1] <= self.y[1])


@dataclass(frozen=True)
class BevGrid:
    """BEVFormer's grid over a range: rows run along y, columns along x, row 0 and column 0 at the low ends.

    Attributes:
        range: the box covered; TopoNet's +-51.2 x +-25.6 m.
        rows, columns: number of cells along y and x.
    """

    range: PerceptionRange = PerceptionRange((-51.2, 51.2), (-25.6, 25.6), (-2.3, 1.7))
    rows: Count = 100
    columns: Count = 200

    @property
    def cell(self) -> tuple[float, float]:
        """Cell size along x and y, metres."""
        size = self.range.size(2)
        return size[0] / self.columns, size[1] / self.rows

    def centers(self) -> tuple[list[float], list[float]]:
        """Return the coordinates of the cell centers, metres: x of each column, y of each row."""
        (dx, dy), (x0, y0) = self.cell, self.range.low(2)
        return (
            [x0 + (c + 0.5) * dx for c in range(self.columns)],
            [y0 + (r + 0.5) * dy for r in range(self.rows)],
        )

    def pixel(self, points: Float[ArrayT, "*b d"]) -> Float[ArrayT, "*b 2"]:
        """Map metres to continuous (column, row) with cell centers at integers."""
        unit = self.range.normalise(points[..., :2])
        return unit * _like(unit, (self.columns, self.rows)) - 0.5


def _like(points: Float[ArrayT, "*b d"], values: tuple[float, ...]) -> Float[ArrayT, "*#b d"]:
    # Of the rank of `points`: the tests run with jax_numpy_rank_promotion="raise".
    return constants(values, points).reshape((1,) * (points.ndim - 1) + (len(values),))
