"""Lane decoder of TopoNet and BEVFormer-DETR: lane queries attend to BEV features; heads predict centerlines.

LaneSegNet shares the decoder layer and the refinement of centerlines; its heads are in `models.lane_segments`. MapTR
shares the decoder layer (`models.map_lines`).

In TopoNet, queries also pass messages along the predicted topology (docs/reference/toponet.md).

Two modes of refinement. "fixed" is TopoNet's: a query samples around one reference point that never moves. "iterative"
starts from learned anchor lanes and moves all their points from layer to layer; each attention head samples around its
own point of the lane (LaneSegNet's heads-to-regions), and each point is refined by the BEV features at its position.
Small models need "iterative" to converge.
"""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.layers.deformable import DeformableAttention
from tflane_jax.layers.graph import ElementNodes, Mlp, RelationshipHead, SceneGraphFeedForward
from tflane_jax.layers.positions import inverse_sigmoid, sine_encoding
from tflane_jax.layers.precision import run_layer
from tflane_jax.layers.sampling import sample_bilinear
from tflane_jax.layers.transformer import FeedForward, TransformerConfig, add_and_norm
from tflane_jax.models.element_decoder import ElementOutput
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.scene import CenterlinePrediction, ElementPrediction, Prediction


@runtime_checkable
class LayerSizes(Protocol):
    """Sizes of `LaneDecoderLayer`, see `LaneDecoderConfig`."""

    @property
    def dim(self) -> int: ...
    @property
    def heads(self) -> int: ...
    @property
    def sampling_points(self) -> int: ...
    @property
    def hidden(self) -> int: ...
    @property
    def dropout(self) -> float: ...


class LaneDecoderLayer(nn.Module):
    """Self-attention, deformable attention to the BEV features, feed-forward or scene graph; post-norm.

    Attributes:
        config: sizes.
        initial: initial sampling offsets, see `DeformableAttention`.
        edge_weight: of the scene graph, see `TopoNetConfig`.
    """

    config: LayerSizes
    initial: Literal["compass", "star"] = "compass"
    edge_weight: float = 0.6

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "q c"],
        position: Float[Array, "q c"],
        around: Float[Array, "q r 2"],
        bev: Float[Array, "h w e"],
        adjacency: Float[Array, "q q"] | None,
        elements: ElementNodes | None = None,
        *,
        deterministic: bool = True,
    ) -> Float[Array, "q c"]:
        """Return the queries after one layer.

        Args:
            queries, position: content of the queries and the position encoding added to it in attention.
            around: reference points in [0, 1], a common one for all heads or one for each head.
            bev: BEV features, row 0 at the smallest y, column 0 at the smallest x.
            adjacency: the previous layer's edge probabilities; None: a layer without scene graph (BEVFormer-DETR,
                LaneSegNet).
            elements: traffic elements of the scene graph, or None.
            deterministic: no dropout.
        """
        config = self.config

        add = partial(add_and_norm, dropout=config.dropout, deterministic=deterministic)

        attend = MultiHeadAttention(config.dim, config.heads, config.dropout, name="self_attention")
        placed = queries + position
        queries = add("self_attention", queries, attend(placed, placed, queries, deterministic=deterministic))
        sample = DeformableAttention(
            config.dim, config.heads, config.sampling_points, initial=self.initial, name="bev_attention"
        )
        h, w, e = bev.shape
        sampled = sample(queries + position, bev.reshape(h * w, e), ((h, w),), around)
        queries = add("bev_attention", queries, sampled)
        if adjacency is None:
            block = FeedForward(TransformerConfig(config.heads, config.hidden, config.dropout), name="feed_forward")
            return add("feed_forward", queries, block(queries, deterministic=deterministic))
        graph = SceneGraphFeedForward(config.dim, config.hidden, self.edge_weight, config.dropout, name="scene_graph")
        queries = graph(queries, adjacency, elements, deterministic=deterministic)
        return nn.LayerNorm(epsilon=1e-5, name="scene_graph_norm")(queries)


class ElementEmbedding(nn.Module):
    """Embeds the queries of the traffic-element decoder for the lane decoder."""

    config: LaneDecoderConfig

    @nn.compact
    def __call__(self, queries: Float[Array, "e d"], *, deterministic: bool = True) -> Float[Array, "e c"]:
        """Return features with the lane decoder's channels."""
        x = nn.relu(nn.Dense(2 * self.config.dim, name="expand")(queries))
        x = nn.Dropout(self.config.dropout, name="dropout")(x, deterministic=deterministic)
        return nn.Dense(self.config.dim, name="contract")(x)


class PointwiseRefinement(nn.Module):
    """Moves each point of a lane by the BEV features at its position.

    One network serves all points of all lanes, whereas the point head has separate weights for every point.

    Attributes:
        config: sizes.
        range: the box that normalised coordinates span.
    """

    config: LaneDecoderConfig
    range: PerceptionRange

    @nn.compact
    def __call__(
        self, queries: Float[Array, "q c"], reference: Float[Array, "q p 3"], bev: Float[Array, "h w e"]
    ) -> Float[Array, "q p 3"]:
        """Return the change of the reference points, in logits of [0, 1]; zero-initialised."""
        config, (h, w, e) = self.config, bev.shape
        here = sample_bilinear(bev.reshape(h * w, e), (h, w), reference[..., :2])
        heading = directions(self.range.denormalise(reference)[..., :2])
        x = nn.Dense(config.dim, name="here")(here)
        x = x + nn.Dense(config.dim, use_bias=False, name="heading")(heading)
        x = x + nn.Dense(config.dim, use_bias=False, name="lane")(queries)[:, None]
        x = x + self.param("place", nn.initializers.normal(0.1), (1, config.points, config.dim), jnp.float32)
        x = nn.relu(nn.Dense(config.dim, name="hidden")(nn.relu(x)))
        # 0.3: Adam's steps have one size for all parameters, but points move by metres and lanes by tens of metres.
        return 0.3 * nn.Dense(3, kernel_init=nn.initializers.zeros, name="change")(x)


class LaneOutput(NamedTuple):
    """Outputs of the heads of one decoder layer.

    Attributes:
        points: (Q, P, 3) metres.
        unit: the same points in [0, 1].
        logits: (Q, 1) of the class "lane".
        successor: (Q, Q) logits of lane-lane edges; None without relationship heads.
        element_lane: (Q, E) logits of lane-element edges; None without relationship heads or elements.
    """

    points: Float[Array, "q p 3"]
    unit: Float[Array, "q p 3"]
    logits: Float[Array, "q 1"]
    successor: Float[Array, "q q"] | None
    element_lane: Float[Array, "q e"] | None


class LaneHeads(nn.Module):
    """Class, centerline and topology of one decoder layer.

    Attributes:
        config: sizes.
        range: the box that normalised coordinates span.
        relations: whether the layer predicts topology.
        limits: the box at whose border lanes end, output "metric" only.
    """

    config: LaneDecoderConfig
    range: PerceptionRange
    relations: bool = True
    limits: PerceptionRange | None = None

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "q c"],
        reference: Float[Array, "q p 3"],
        bev: Float[Array, "h w e"],
        elements: Float[Array, "n d"] | None = None,
    ) -> LaneOutput:
        """Return the layer's prediction; `elements` are traffic-element features or None."""
        config = self.config
        x = queries
        for i in range(2):
            x = nn.Dense(config.dim, name=f"class_{i}")(x)
            x = nn.relu(nn.LayerNorm(epsilon=1e-5, name=f"class_norm_{i}")(x))
        # Bias -log 99: the initial probability is 0.01 (focal loss prior, Lin et al. 2017).
        logits = nn.Dense(1, bias_init=nn.initializers.constant(-np.log(99.0)), name="class_out")(x)
        # The change of the reference, in logits of [0, 1] or in units of `metres`.
        change = Mlp((config.dim, config.dim, config.points * 3), name="points")(queries).reshape(reference.shape)
        unit = refined_points(config, self.range, self.limits, change, reference, queries, bev)
        successor = element_lane = None
        if self.relations:
            successor = relate(self, config, "successor", queries, queries)
            if elements is not None:
                element_lane = relate(self, config, "element_lane", queries, elements)
        return LaneOutput(self.range.denormalise(unit), unit, logits, successor, element_lane)


def relate(
    parent: nn.Module, config: LaneDecoderConfig, name: str, a: Float[Array, "a c"], b: Float[Array, "b c"]
) -> Float[Array, "a b"]:
    """Return a logit for each pair, by the submodule `name` of a compact module."""
    return run_layer(parent, partial(RelationshipHead, config.relation, name=name), config, a, b)


def refined_points(
    config: LaneDecoderConfig,
    range_: PerceptionRange,
    limits: PerceptionRange | None,
    change: Float[Array, "q p 3"],
    reference: Float[Array, "q p 3"],
    queries: Float[Array, "q c"],
    bev: Float[Array, "h w e"],
) -> Float[Array, "q p 3"]:
    """Return the points of a layer in [0, 1], from the change that its head gives; part of a compact module.

    Args:
        config: sizes and forms; "iterative" adds the module `pointwise`.
        range_: the box that normalised coordinates span.
        limits: the box at whose border lanes end, output "metric" only; None: `range_`.
        change: of the reference, in logits of [0, 1] or in units of `metres`.
        reference: points of the layer before, in [0, 1].
        queries, bev: see `PointwiseRefinement`.
    """
    if config.refine == "iterative":
        change = jnp.einsum("pk,qkc->qpc", smooth_basis(config.points), change, precision="highest")
        change = change + PointwiseRefinement(config, range_, name="pointwise")(queries, reference, bev)
    if config.output == "sigmoid":
        return nn.sigmoid(change + inverse_sigmoid(reference))
    scale = jnp.asarray(config.metres) / jnp.asarray(range_.size())
    return clipped(reference + change * scale[None, None], range_, limits)


def clipped(
    unit: Float[Array, "q p d"], range_: PerceptionRange, limits: PerceptionRange | None
) -> Float[Array, "q p d"]:
    """Return points (d = 2 or 3) in [0, 1] of `range_` clipped to the limits by `clip_with_return`."""
    box = limits or range_
    axes = (box.x, box.y, box.z)[: unit.shape[-1]]
    corners = range_.normalise(jnp.array([[axis[end] for axis in axes] for end in (0, 1)]))
    low, high = (jnp.broadcast_to(corners[i], unit.shape[1:]) for i in (0, 1))
    return jax.vmap(clip_with_return, in_axes=(0, None, None))(unit, low, high)


def lane_position(
    config: LaneDecoderConfig, layer: int, position: Float[Array, "q c"], reference: Float[Array, "q p 3"]
) -> Float[Array, "q c"]:
    """Return the position encoding of the queries in a layer; part of a compact module.

    "iterative": the encoding follows the refined lane, by the module `lane_position_{layer}`.
    """
    if config.refine != "iterative":
        return position
    along = jnp.concatenate([sine_encoding(reference[..., :2], config.bands), reference], -1)
    return position + Mlp((config.dim, config.dim), name=f"lane_position_{layer}")(along.reshape(len(reference), -1))


@jax.custom_vjp
def clip_with_return(x: Float[Array, "*b"], low: Float[Array, "*b"], high: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Clip to [low, high], with a gradient for a value outside if descent along it moves the value back inside.

    The gradient of a plain clip is 0 outside, so that a lane which leaves the range could never return. Passing every
    gradient would let a rounding error between a clipped value and a target on the border push it outwards for ever.
    """
    return jnp.clip(x, low, high)


def _clip_forward(x, low, high):
    return jnp.clip(x, low, high), (x, low, high)


def _clip_backward(residuals, gradient):
    x, low, high = residuals
    outward = ((x > high) & (gradient < 0.0)) | ((x < low) & (gradient > 0.0))
    return jnp.where(outward, 0.0, gradient), jnp.zeros_like(low), jnp.zeros_like(high)


clip_with_return.defvjp(_clip_forward, _clip_backward)


def make_prediction(outputs: list[LaneOutput], elements: ElementOutput | None) -> Prediction:
    """Return lanes, elements and topologies with a leading axis over decoder layers.

    For a topology, this axis has only the layers that predict it, always the last ones.
    """
    related = [output for output in outputs if output.successor is not None]
    lanes = CenterlinePrediction(
        points=jnp.stack([output.points for output in outputs]),
        logits=jnp.stack([output.logits for output in outputs]),
        successor_logits=jnp.stack([output.successor for output in related]),  # pyright: ignore[reportArgumentType]
    )
    if elements is None:
        return Prediction(centerlines=lanes)
    edges = jnp.stack([output.element_lane for output in related])  # pyright: ignore[reportArgumentType]
    boxes = ElementPrediction(elements.box, elements.logits, edges)
    return Prediction(centerlines=lanes, elements=boxes)


def smooth_basis(points: int) -> Float[np.ndarray, "p k"]:
    """Return a basis of lane deformations: column k is cos(k pi t) along the lane, scaled by 1 / k^2.

    The columns span all point displacements, but favour smooth ones: column 0 moves the lane, column 1 turns and
    stretches it, column 2 bends it. Equal changes of free points would make it zigzag.
    """
    along = np.linspace(0.0, np.pi, points)
    order = np.arange(points)
    return (np.cos(along[:, None] * order) / np.maximum(order, 1) ** 2).astype(np.float32)


def directions(points: Float[Array, "*b p 2"]) -> Float[Array, "*b p 2"]:
    """Return the unit direction at each point of a polyline, by central differences; 0 where points coincide."""
    before = jnp.concatenate([points[..., :1, :], points[..., :-1, :]], -2)
    after = jnp.concatenate([points[..., 1:, :], points[..., -1:, :]], -2)
    step = after - before
    return step / jnp.sqrt((step**2).sum(-1, keepdims=True) + 1e-6)


def attention_reference(reference: Float[Array, "q p 3"], config: LaneDecoderConfig) -> Float[Array, "q r 2"]:
    """Return the reference points of the heads: a common one ("fixed"), or one per head, spread along the lane."""
    if config.refine == "fixed":
        return reference[:, :1, :2]
    return reference[:, spread_points(config.points, config.heads), :2]


def spread_points(points: int, count: int) -> np.ndarray:
    """Return the indices of `count` of a line's points, spread from end to end; a single one is in the middle."""
    return np.linspace(0, points - 1, count).round().astype(int) if count > 1 else np.array([points // 2])


def next_reference(
    reference: Float[Array, "q p 3"], unit: Float[Array, "q p 3"], config: LaneDecoderConfig
) -> Float[Array, "q p 3"]:
    """Return the reference of the next layer, without gradient, as in Deformable DETR."""
    return reference if config.refine == "fixed" else lax.stop_gradient(unit)
