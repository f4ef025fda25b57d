"""Crossings and road boundaries as lines with queries of their own (LaneSegNet's map-element-bucket variant).

The decoder is MapTR's: instance and point queries, whose points every layer moves (`models.map_lines`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.limits import Count, counted
from tflane_jax.models.map_lines import LineDecoderConfig, LineOutput, LineQueries, decode_line_layers
from tflane_jax.scene import AreaPrediction

AREA_CLASSES = 2
"""Pedestrian crossing, road boundary: `scene.AreaType` less 1."""


@dataclass(frozen=True)
class AreaDecoderConfig(LineDecoderConfig):
    """Sizes and forms of the decoder. Sizes train on two CPU cores; `PAPER_AREA_DECODER` has the variant's.

    Attributes:
        output: as of `LineDecoderConfig`; "raw" is the fault of the published code: the predicted points are the raw
            change, scaled to the range, without the reference and the sigmoid by which the decoder refines them. Its
            weights need it.
        coordinates, classes: those of areas.
        others: see `LineDecoderConfig`.
    """

    queries: Count = 12
    points: Annotated[int, counted(2)] = 20
    coordinates: Literal[3] = 3  # pyright: ignore[reportIncompatibleVariableOverride]
    classes: Literal[2] = AREA_CLASSES  # pyright: ignore[reportIncompatibleVariableOverride]


PAPER_AREA_DECODER = AreaDecoderConfig(dim=256, layers=6, queries=50, class_layers=1, hidden=512, dropout=0.1)


class AreaDecoder(nn.Module):
    """From BEV features to areas of every decoder layer.

    Attributes:
        config: sizes and forms.
        range: the box that normalised coordinates span.
        limits: the box at whose border lines end.
    """

    config: AreaDecoderConfig
    range: PerceptionRange
    limits: PerceptionRange

    @nn.compact
    def __call__(self, bev: Float[Array, "h w e"], *, deterministic: bool) -> AreaPrediction:
        """Return areas with a leading axis over decoder layers; `deterministic`: no dropout."""
        start = LineQueries(self.config, self.range, name="queries")()
        outputs = decode_line_layers(
            self, self.config, start, bev, self.range, self.limits, deterministic=deterministic
        )
        layers: LineOutput = jax.tree.map(lambda *leaves: jnp.stack(leaves), *outputs)
        return AreaPrediction(layers.points, layers.logits)
