"""Parts of MapTR's decoder (Liao et al. 2023): instance and point queries, and the heads of map lines.

A line is a group of P point queries. Each starts as the sum of an embedding of its line and one of its place along the
line. Every decoder layer moves all points; the class of a line comes from the mean of its queries.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.positions import inverse_sigmoid, sine_encoding
from tflane_jax.layers.precision import Precision, run_layer
from tflane_jax.limits import Count, FractionBelowOne, Positive, Rules, counted, splits
from tflane_jax.models.lane_decoder import LaneDecoderLayer, clipped
from tflane_jax.models.lane_denoising import DenoisingConfig, noised_lanes
from tflane_jax.models.lane_queries import spread_lanes
from tflane_jax.models.lane_segments import Branch
from tflane_jax.scene import MapLines


@dataclass(frozen=True)
class LineDecoderConfig:
    """Sizes and forms of the decoder. Sizes train on two CPU cores; `PAPER_LINE_DECODER` has MapTR's.

    Attributes:
        dim: channels of a query.
        heads: attention heads.
        layers: decoder layers.
        queries: lines I.
        points: points P of a line; the decoder has I P queries.
        coordinates: number of coordinates of a point: x and y, or x, y and z.
        classes: of `scene.LineClass`, the first three or four; two for areas (`models.area_decoder`).
        class_layers: hidden layers of the class branch.
        sampling_points: deformable sampling points per head.
        hidden: channels inside the feed-forward block.
        anchors: "linear": a point starts at the sigmoid of a linear function of its embedding, and its position
            encoding stays, as in MapTR. "spread": the points start on learned lines, initially straight ones spread
            over the range, and the position encoding follows them from layer to layer.
        bands: frequencies per coordinate of the position encoding of a refined line.
        output: "sigmoid" adds the change of a point to the logit of its reference, as in MapTR; "metric" adds it in
            units of `metres` and clips at the border of the perception range, see `LaneDecoderConfig.output`; "raw" is
            a fault that published weights need, see `models.area_decoder`.
        metres: unit of change along x, y and z where the output is "metric".
        dropout: probability, for attention weights, hidden channels and every residual branch.
        precision: dtype of linear layers, see `layers.precision`; parameters, points and scores are float32.
        remat: recompute each layer's activations for the gradient instead of keeping them.
    """

    dim: Count = 64
    heads: Count = 8
    layers: Count = 3
    queries: Count = 30
    points: Annotated[int, counted(2)] = 12
    coordinates: Literal[2, 3] = 2
    classes: Literal[2, 3, 4] = 3
    class_layers: Count = 2
    sampling_points: Count = 4
    hidden: Count = 128
    anchors: Literal["linear", "spread"] = "linear"
    bands: Count = 6
    output: Literal["sigmoid", "metric", "raw"] = "sigmoid"
    metres: tuple[Positive, Positive, Positive] = (5.0, 5.0, 0.3)
    dropout: FractionBelowOne = 0.0
    precision: Precision = "float32"
    remat: bool = False

    def limits(self) -> Rules:
        """Channels split over heads."""
        yield splits("heads", self.heads, "dim", self.dim)


PAPER_LINE_DECODER = LineDecoderConfig(dim=256, layers=6, queries=50, points=20, hidden=512, dropout=0.1)


class PointQueries(NamedTuple):
    """The queries of I lines before the first layer.

    Attributes:
        content, position: (I, P, C); the position is added to the content in attention.
        reference: (I, P, D) points in [0, 1].
    """

    content: Float[Array, "*b i p c"]
    position: Float[Array, "*b i p c"]
    reference: Float[Array, "*b i p d"]


class LineQueries(nn.Module):
    """The learned queries.

    Attributes:
        config: sizes and forms.
        range: the box that normalised coordinates span.
        more: lines beyond `config.queries`, the last ones.
    """

    config: LineDecoderConfig
    range: PerceptionRange
    more: int = 0

    @nn.compact
    def __call__(self) -> PointQueries:
        """Return content, position and initial points."""
        config, normal, count = self.config, nn.initializers.normal(1.0), self.config.queries + self.more
        lines = self.param("instances", normal, (count, 2 * config.dim), jnp.float32)
        points = self.param("points", normal, (config.points, 2 * config.dim), jnp.float32)
        position, content = jnp.split(lines[:, None] + points[None], 2, -1)
        if config.anchors == "spread":
            start = spread_lanes(count, config.points, self.range)[..., : config.coordinates]
            anchors = self.param("anchors", lambda _: inverse_sigmoid(jnp.asarray(start, jnp.float32)))
            return PointQueries(content, position, nn.sigmoid(anchors))
        place = nn.Dense(config.coordinates, kernel_init=nn.initializers.xavier_uniform(), name="reference")
        return PointQueries(content, position, nn.sigmoid(place(position)))


class NoisedLines(nn.Module):
    """Queries placed on noised map lines, for training (`models.lane_denoising`).

    Attributes:
        config: sizes and forms, with anchors "spread": only then do the queries encode where their points are.
        noise: added to the lines.
        range: the box that normalised coordinates span.
    """

    config: LineDecoderConfig
    noise: DenoisingConfig
    range: PerceptionRange

    @nn.compact
    def __call__(self, lines: MapLines) -> PointQueries:
        """Return the queries of every copy, as a leading axis; line i of a copy belongs to line i of the truth."""
        config, copies = self.config, self.noise.copies
        keys = jax.random.split(self.make_rng("dropout"), copies)
        noised = jax.vmap(lambda key: noised_lanes(key, lines, config.queries, self.range, self.noise))(keys)
        # Away from 0 and 1, where the sigmoid of the points is flat.
        border = 0.0 if config.output == "metric" else 0.01
        reference = jnp.clip(self.range.normalise(noised[..., : config.coordinates]), border, 1.0 - border)
        learned = self.param("points", nn.initializers.normal(1.0), (config.points, 2 * config.dim), jnp.float32)
        learned = jnp.broadcast_to(learned, (*reference.shape[:2], *learned.shape))
        position, content = jnp.split(learned, 2, -1)
        return PointQueries(content, position, lax.stop_gradient(reference))


def point_position(
    config: LineDecoderConfig, layer: int, position: Float[Array, "i p c"], reference: Float[Array, "i p d"]
) -> Float[Array, "i p c"]:
    """Return the position encoding of the queries in a layer; part of a compact module.

    Anchors "spread": the encoding follows the points, by the module `point_position_{layer}`.
    """
    if config.anchors == "linear":
        return position
    place = jnp.concatenate([sine_encoding(reference[..., :2], config.bands), reference], -1)
    return position + Mlp((config.dim, config.dim), name=f"point_position_{layer}")(place)


class LineOutput(NamedTuple):
    """Outputs of the heads of one decoder layer.

    Attributes:
        points: (I, P, D) metres.
        unit: the same points in [0, 1].
        logits: (I, classes).
    """

    points: Float[Array, "i p d"]
    unit: Float[Array, "i p d"]
    logits: Float[Array, "i k"]


class LineHeads(nn.Module):
    """Classes and points of one decoder layer.

    Attributes:
        config: sizes and forms.
        range: the box that normalised coordinates span.
        limits: the box at whose border lines end, output "metric" only.
    """

    config: LineDecoderConfig
    range: PerceptionRange
    limits: PerceptionRange | None = None

    @nn.compact
    def __call__(self, queries: Float[Array, "i p c"], reference: Float[Array, "i p d"]) -> LineOutput:
        """Return the layer's prediction; `reference` are the points of the layer before, in [0, 1]."""
        config, size = self.config, self.config.coordinates
        # The initial probability is 0.01 (focal loss prior, Lin et al. 2017).
        classify = Branch(
            (*(config.dim,) * config.class_layers, config.classes), norm=True, bias=-math.log(99.0), name="class"
        )
        logits = classify(queries.mean(1))
        change = Branch((config.dim, config.dim, size), name="points")(queries)
        if config.output != "metric":
            unit = nn.sigmoid(change + inverse_sigmoid(reference))
        else:
            scale = jnp.asarray(config.metres[:size]) / jnp.asarray(self.range.size(size))
            unit = clipped(reference + change * scale[None, None], self.range, self.limits)
        return LineOutput(self.range.denormalise(change if config.output == "raw" else unit), unit, logits)


def decode_line_layers(
    module: nn.Module,
    config: LineDecoderConfig,
    start: PointQueries,
    bev: Float[Array, "h w e"],
    range_: PerceptionRange,
    limits: PerceptionRange | None,
    *,
    deterministic: bool,
) -> list[LineOutput]:
    """Return the outputs of all decoder layers of a host's part without priors; part of a compact module.

    The modules are `layer_{i}` and `heads_{i}`; the hosts of map lines have this loop, with priors, in their files.

    Args:
        module: the compact module that is being called.
        config: sizes and forms.
        start: queries and points before the first layer.
        bev: BEV features.
        range_, limits: of the heads, see `LineHeads`.
        deterministic: no dropout.
    """
    content, position, reference = start
    queries, outputs = content.reshape(-1, config.dim), []
    for i in range(config.layers):
        placed = point_position(config, i, position, reference).reshape(-1, config.dim)
        around = reference[..., :2].reshape(-1, 1, 2)
        layer, inputs = partial(LaneDecoderLayer, config, name=f"layer_{i}"), (queries, placed, around, bev, None)
        queries = run_layer(module, layer, config, *inputs, deterministic=deterministic)
        heads = LineHeads(config, range_, limits, name=f"heads_{i}")
        outputs.append(heads(queries.reshape(content.shape), reference))
        reference = lax.stop_gradient(outputs[-1].unit)
    return outputs
