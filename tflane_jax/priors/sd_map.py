"""The SD-map prior of SMERF (Luo et al. 2024), up to the learned part: road-level polylines as coordinates and labels.

Runs in numpy or under jit, depending on the arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

from flax import struct
from jaxtyping import Bool, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.namespace import namespace
from tflane_jax.limits import Count
from tflane_jax.scene import SdCategory, SdMap
from tflane_jax.scene.arrays import Array


@dataclass(frozen=True)
class SdMapPriorConfig:
    """Encoding of an SD map.

    Attributes:
        categories: number of labels, `scene.SdCategory`; larger categories count as the last one.
    """

    categories: Count = len(SdCategory)


@struct.dataclass
class SdMapLines:
    """Lines of an SD map as the encoder reads them: R lines of P points.

    Attributes:
        points: (R, P, 2) in [0, 1] inside the range; 0 in padding.
        labels: (R, K) one-hot category; 0 in padding.
        valid: (R,).
    """

    points: Float[Array, "r p 2"]
    labels: Float[Array, "r k"]
    valid: Bool[Array, " r"]


def sd_map_lines(sd_map: SdMap, config: SdMapPriorConfig, bev_range: PerceptionRange) -> SdMapLines:
    """Return the lines of one frame's SD map; padding may hold anything.

    Coordinates are normalised by `bev_range`, the box of the host's BEV features.
    """
    xp = namespace(sd_map.points, sd_map.category, sd_map.valid)
    points = xp.where(sd_map.valid[:, None, None], sd_map.points, 0.0)
    known = (sd_map.category >= 0) & (sd_map.category < config.categories)
    category = xp.where(known, sd_map.category, config.categories - 1)
    labels = (category[:, None] == xp.arange(config.categories)[None]) & sd_map.valid[:, None]
    return SdMapLines(
        points=xp.where(sd_map.valid[:, None, None], bev_range.normalise(points), 0.0),
        labels=labels.astype(points.dtype),
        valid=sd_map.valid,
    )
