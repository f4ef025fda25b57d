"""Lane decoder of TopoNet and BEVFormer-DETR: queries look at BEV features, and heads make centerlines of them.

In TopoNet they also pass messages along the predicted topology.

Reference: specs/modules.md section 5. Two modes of refinement: "fixed" is TopoNet's own, where a query looks around one
reference point that never moves; "iterative" starts from learned anchor lanes, moves all points from layer to layer,
and lets each attention head look around its own point of the lane (LaneSegNet's heads-to-regions), and refines each
point by what is seen there, which small models need to converge.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.attention import MultiHeadAttention
from tflane_jax.layers.deformable import DeformableAttention, sample_bilinear
from tflane_jax.layers.graph import ElementNodes, Mlp, RelationshipHead, SceneGraphFeedForward
from tflane_jax.layers.positions import inverse_sigmoid
from tflane_jax.layers.transformer import FeedForward, TransformerConfig
from tflane_jax.models.element_decoder import ElementOutput
from tflane_jax.models.lane_queries import LaneDecoderConfig
from tflane_jax.scene import CenterlinePrediction, ElementPrediction, Prediction


class LaneDecoderLayer(nn.Module):
    """Self-attention, deformable attention to the BEV, feed-forward with or without the scene graph; post-norm."""

    config: LaneDecoderConfig

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "q c"],
        position: Float[Array, "q c"],
        reference: Float[Array, "q p 3"],
        bev: Float[Array, "h w e"],
        adjacency: Float[Array, "q q"] | None,
        elements: ElementNodes | None = None,
        *,
        deterministic: bool = True,
    ) -> Float[Array, "q c"]:
        """Return the queries after one layer.

        Args:
            queries, position: content of the queries and what is added to it where they look around.
            reference: where their lanes are, in [0, 1].
            bev: BEV features, row 0 at the least y, column 0 at the least x.
            adjacency: the previous layer's edge probabilities; None is a layer without scene graph (BEVFormer-DETR).
            elements: traffic elements for the scene graph, if the host has them.
            deterministic: no dropout.
        """
        config = self.config

        def add(name, x, change):
            change = nn.Dropout(config.dropout, name=f"{name}_dropout")(change, deterministic=deterministic)
            return nn.LayerNorm(epsilon=1e-5, name=f"{name}_norm")(x + change)

        attend = MultiHeadAttention(config.dim, config.heads, config.dropout, name="self_attention")
        where = queries + position
        queries = add("self_attention", queries, attend(where, where, queries, deterministic=deterministic))
        look = DeformableAttention(config.dim, config.heads, config.sampling_points, name="bev_attention")
        (h, w, e), around = bev.shape, attention_reference(reference, config)
        seen = look(queries + position, bev.reshape(h * w, e), ((h, w),), around)
        queries = add("bev_attention", queries, seen)
        if adjacency is None:
            block = FeedForward(TransformerConfig(config.heads, config.hidden, config.dropout), name="feed_forward")
            return add("feed_forward", queries, block(queries, deterministic=deterministic))
        graph = SceneGraphFeedForward(config.dim, config.hidden, config.edge_weight, config.dropout, name="scene_graph")
        queries = graph(queries, adjacency, elements, deterministic=deterministic)
        return nn.LayerNorm(epsilon=1e-5, name="scene_graph_norm")(queries)


class ElementEmbedding(nn.Module):
    """Traffic-element queries of the front view, embedded for the lane decoder."""

    config: LaneDecoderConfig

    @nn.compact
    def __call__(self, queries: Float[Array, "e d"], *, deterministic: bool = True) -> Float[Array, "e c"]:
        """Return the elements' features."""
        x = nn.relu(nn.Dense(2 * self.config.dim, name="expand")(queries))
        x = nn.Dropout(self.config.dropout, name="dropout")(x, deterministic=deterministic)
        return nn.Dense(self.config.dim, name="contract")(x)


class PointwiseRefinement(nn.Module):
    """Moves each point of a lane by what is seen there, with one network for all points of all lanes.

    The heads' own perceptron must learn for every point anew what a line beside it means; this one learns it once.

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
        """Return the change of the reference points, zero before training."""
        config, (h, w, e) = self.config, bev.shape
        here = sample_bilinear(bev.reshape(h * w, e), (h, w), reference[..., :2])
        heading = directions(self.range.denormalise(reference)[..., :2])
        x = nn.Dense(config.dim, name="here")(here)
        x = x + nn.Dense(config.dim, use_bias=False, name="heading")(heading)
        x = x + nn.Dense(config.dim, use_bias=False, name="lane")(queries)[:, None]
        x = x + self.param("place", nn.initializers.normal(0.1), (1, config.points, config.dim))
        x = nn.relu(nn.Dense(config.dim, name="hidden")(nn.relu(x)))
        # 0.3: Adam's steps are of one size for all parameters, and a point moves by metres where a lane moves by tens.
        return 0.3 * nn.Dense(3, kernel_init=nn.initializers.zeros, name="change")(x)


class LaneOutput(NamedTuple):
    """What the heads of one decoder layer say.

    Attributes:
        points: (Q, P, 3) metres.
        unit: the same points in [0, 1].
        logits: (Q, 1) of the class.
        successor: (Q, Q) logits of lane-lane edges, None where the layer has no relationship heads.
        element_lane: (Q, E) logits of lane-element edges, None where there are no elements either.
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
    """

    config: LaneDecoderConfig
    range: PerceptionRange
    relations: bool = True

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "q c"],
        reference: Float[Array, "q p 3"],
        bev: Float[Array, "h w e"],
        elements: Float[Array, "n d"] | None = None,
    ) -> LaneOutput:
        """Return the layer's prediction; `elements` are features of traffic elements."""
        config = self.config
        x = queries
        for i in range(2):
            x = nn.Dense(config.dim, name=f"class_{i}")(x)
            x = nn.relu(nn.LayerNorm(epsilon=1e-5, name=f"class_norm_{i}")(x))
        # Bias -log 99: every query starts as one percent likely (focal loss prior).
        logits = nn.Dense(1, bias_init=nn.initializers.constant(-np.log(99.0)), name="class_out")(x)
        # The change of the reference, in logits of [0, 1].
        change = Mlp((config.dim, config.dim, config.points * 3), name="points")(queries).reshape(reference.shape)
        if config.refine == "iterative":
            change = jnp.einsum("pk,qkc->qpc", smooth_basis(config.points), change)
            change = change + PointwiseRefinement(config, self.range, name="pointwise")(queries, reference, bev)
        unit = nn.sigmoid(change + inverse_sigmoid(reference))
        successor = element_lane = None
        if self.relations:
            successor = RelationshipHead(config.relation, name="successor")(queries, queries)
            if elements is not None:
                element_lane = RelationshipHead(config.relation, name="element_lane")(queries, elements)
        return LaneOutput(self.range.denormalise(unit), unit, logits, successor, element_lane)


def make_prediction(outputs: list[LaneOutput], elements: ElementOutput | None) -> Prediction:
    """Return lanes, elements and topologies with a leading axis over decoder layers.

    The axis of a topology counts only the layers, always the last ones, that predict it.
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
    """Return cosines along a lane as columns, the k-th scaled by 1 / k^2: the shapes that a lane is moved by.

    The columns span everything that free points do, but an equal change of all coefficients bends a lane instead of
    making it zigzag: the first moves it, the second turns and stretches it, the third bends it.
    """
    along = np.linspace(0.0, np.pi, points)
    order = np.arange(points)
    return (np.cos(along[:, None] * order) / np.maximum(order, 1) ** 2).astype(np.float32)


def directions(points: Float[Array, "*b p 2"]) -> Float[Array, "*b p 2"]:
    """Return the unit direction of travel at each point of a polyline, by central differences; 0 where it stands."""
    before = jnp.concatenate([points[..., :1, :], points[..., :-1, :]], -2)
    after = jnp.concatenate([points[..., 1:, :], points[..., -1:, :]], -2)
    step = after - before
    return step / jnp.sqrt((step**2).sum(-1, keepdims=True) + 1e-6)


def attention_reference(reference: Float[Array, "q p 3"], config: LaneDecoderConfig) -> Float[Array, "q r 2"]:
    """Return where the heads look: one common point ("fixed"), or points spread along the lane, one for each head."""
    if config.refine == "fixed":
        return reference[:, :1, :2]
    along = np.linspace(0, config.points - 1, config.heads).round().astype(int)
    return reference[:, along, :2]


def next_reference(
    reference: Float[Array, "q p 3"], unit: Float[Array, "q p 3"], config: LaneDecoderConfig
) -> Float[Array, "q p 3"]:
    """Return the reference of the next layer; like Deformable DETR's it carries no gradient."""
    return reference if config.refine == "fixed" else lax.stop_gradient(unit)
