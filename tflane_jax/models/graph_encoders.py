"""Graph encoders in place of LSTR's transformer encoder (GTN lane paper, section 2.1): GTN, GCN and HAN.

The paper puts Graph Transformer Networks (docs/reference/gtn.md) into the encoding layer, names GCN and HAN as other
methods, without numbers, and shares parameters between GNN and transformer; it gives no details. Our reading: an
encoder layer keeps the transformer's structure (residual, norm, feed-forward, residual, norm), and graph convolution on
learned meta-paths replaces self-attention. The nodes are the cells of the feature map, the edge types those of
`layers.image_graph`.

Self-attention is one of the GTN's edge types, called similarity: its adjacency comes from the query and key projections
of features + position, and the value and output projections are the weights of the graph convolution on all meta-paths.
GNN and transformer thus share their parameters. With LSTR's two heads the GTN adds only the selection weights, hops *
channels * edge types, and a layer that selects similarity in one hop and `self` in all others is exactly the
transformer's encoder layer, dropout included. With one head, the default, queries and keys are half as wide.

A layer costs about as much as the transformer's: products of adjacencies are never formed (FastGTN), the other edge
types are shifts and means, and similarity, with one head for all channels, is offered to the last hop only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from tflane_jax.layers.attention import Drop, WeightDropout, attention_probabilities, masked_attention
from tflane_jax.layers.graph_transformer import propagate
from tflane_jax.layers.image_graph import (
    AXES,
    Relation,
    attend_along,
    attend_near,
    bordered_sides,
    mix_relations,
    smooth,
)
from tflane_jax.layers.masks import key_mask
from tflane_jax.layers.precision import PLAIN, Computation, full, run_layer
from tflane_jax.limits import DIFFERENT, NOT_EMPTY, Count, FractionBelowOne, Rules


@dataclass(frozen=True)
class GtnEncoderConfig:
    """Graph Transformer Network encoder.

    Attributes:
        layers: encoder layers.
        hops: length of a meta-path, in edges.
        channels: meta-paths; the features are split evenly over them.
        relations: structural edge types to select from.
        similarity: attention over all cells as an additional, last edge type: offered to the last hop only, to every
            hop (the same attention), or to none (None), for a purely structural graph.
        heads: heads of similarity; one for all channels is cheapest.
        head_dim: channels of query and key of a head, as in LSTR's attention.
        hidden: hidden channels of the feed-forward network.
        dropout: probability for attention weights, hidden channels and each residual branch.
    """

    layers: Count = 2
    hops: Count = 2
    channels: Count = 2
    relations: Annotated[tuple[Relation, ...], DIFFERENT] = ("self", "up", "down", "left", "right", "row", "column")
    similarity: Literal["last_hop", "every_hop"] | None = "last_hop"
    heads: Count = 1
    head_dim: Count = 16
    hidden: Count = 128
    dropout: FractionBelowOne = 0.1

    def limits(self) -> Rules:
        """Every hop has edge types."""
        yield "relations", bool(self.relations) or self.offers_similarity(0), "at least one, or similarity every_hop"

    def build(self, name: str, computation: Computation = PLAIN) -> GraphEncoder:
        """Return the Linen module; it infers the number of features from its input."""
        return GraphEncoder(self, computation, name=name)

    def offers_similarity(self, hop: int) -> bool:
        """Return whether a hop may select similarity."""
        return self.similarity == "every_hop" or (self.similarity == "last_hop" and hop == self.hops - 1)

    def mixing(self, name: str) -> MetaPathConvolution:
        """Return the module that replaces self-attention in a layer."""
        return MetaPathConvolution(self, name=name)


@dataclass(frozen=True)
class GcnEncoderConfig:
    """Graph convolution over the 8 neighbours (Kipf & Welling 2017).

    Attributes:
        layers: encoder layers.
        hidden: hidden channels of the feed-forward network.
        dropout: probability for hidden channels and each residual branch.
    """

    layers: Count = 2
    hidden: Count = 128
    dropout: FractionBelowOne = 0.1

    def build(self, name: str, computation: Computation = PLAIN) -> GraphEncoder:
        """Return the Linen module; it infers the number of features from its input."""
        return GraphEncoder(self, computation, name=name)

    def mixing(self, name: str) -> NeighbourConvolution:
        """Return the module that replaces self-attention in a layer."""
        return NeighbourConvolution(name=name)


HanRelation = Literal[
    "near",
    "row",
    "column",
    "near+near",
    "near+row",
    "near+column",
    "row+near",
    "row+column",
    "column+near",
    "column+row",
]


@dataclass(frozen=True)
class HanEncoderConfig:
    """Heterogeneous graph attention network (Wang et al. 2019).

    Attributes:
        layers: encoder layers.
        heads: heads of node-level attention.
        relations: meta-paths: `near` is the cell and its 8 neighbours, `row` and `column` lie along an axis; `near+row`
            is composed of two edges, of which the first one acts first.
        semantic: channels of semantic-level attention.
        hidden: hidden channels of the feed-forward network.
        dropout: probability for attention weights, hidden channels and each residual branch.
    """

    layers: Count = 2
    heads: Count = 2
    relations: Annotated[tuple[HanRelation, ...], NOT_EMPTY, DIFFERENT] = ("near", "row", "column")
    semantic: Count = 32
    hidden: Count = 128
    dropout: FractionBelowOne = 0.1

    def build(self, name: str, computation: Computation = PLAIN) -> GraphEncoder:
        """Return the Linen module; it infers the number of features from its input."""
        return GraphEncoder(self, computation, name=name)

    def mixing(self, name: str) -> HeterogeneousAttention:
        """Return the module that replaces self-attention in a layer."""
        return HeterogeneousAttention(self, name=name)


GraphEncoderConfig = GtnEncoderConfig | GcnEncoderConfig | HanEncoderConfig


class GraphEncoder(nn.Module):
    """Encoder layers over the graph of a feature map.

    Attributes:
        config: sizes.
        computation: precision of linear layers, and whether each layer is computed again for the gradient.
    """

    config: GraphEncoderConfig
    computation: Computation = PLAIN

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "h w c"],
        position: Float[Array, "h w c"],
        valid: Bool[Array, "h w"],
        *,
        deterministic: bool = True,
    ) -> Float[Array, "h w c"]:
        """Return the encoder output; invalid cells have no influence and are 0.

        If the collection `intermediates` is mutable, each layer sows `relations`, the weights of the edge types (hops,
        channels, types), with one hop and one channel except for the GTN, and its attention weights.

        Args:
            features, position: of each cell; position encodings enter queries and keys only.
            valid: cells that show the image, not padding.
            deterministic: no dropout.
        """
        shown = valid[..., None]
        x, position = jnp.where(shown, features, 0.0), jnp.where(shown, position, 0.0)
        for i in range(self.config.layers):
            layer = partial(GraphEncoderLayer, self.config, name=f"layer_{i}")
            x = run_layer(self, layer, self.computation, x, position, valid, deterministic=deterministic)
        return jnp.where(shown, x, 0.0)


class GraphEncoderLayer(nn.Module):
    """The transformer's encoder layer with a graph network in place of self-attention."""

    config: GraphEncoderConfig

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "h w c"],
        position: Float[Array, "h w c"],
        valid: Bool[Array, "h w"],
        *,
        deterministic: bool = True,
    ) -> Float[Array, "h w c"]:
        """Return the features after the layer."""
        config = self.config

        def drop(name, x):
            return nn.Dropout(config.dropout, name=name)(x, deterministic=deterministic)

        drops = config.dropout > 0 and not deterministic
        drop_weights = WeightDropout(config.dropout, deterministic=False, name="weights_dropout") if drops else None
        mixed = config.mixing("graph")(x, position, valid, drop_weights)
        x = nn.LayerNorm(epsilon=1e-5, name="graph_norm")(x + drop("graph_dropout", mixed))
        hidden = drop("hidden_dropout", nn.relu(nn.Dense(config.hidden, name="expand")(x)))
        fed = nn.Dense(x.shape[-1], name="contract")(hidden)
        return nn.LayerNorm(epsilon=1e-5, name="fed_norm")(x + drop("fed_dropout", fed))


class MetaPathConvolution(nn.Module):
    """Graph convolution on learned meta-paths; attention is one of the edge types."""

    config: GtnEncoderConfig

    @nn.compact
    def __call__(
        self, x: Float[Array, "h w c"], position: Float[Array, "h w c"], valid: Bool[Array, "h w"], drop: Drop = None
    ) -> Float[Array, "h w c"]:
        """Return the change of x, without the residual."""
        config, dim = self.config, x.shape[-1]
        offered = [config.offers_similarity(hop) for hop in range(config.hops)]
        structural = len(config.relations)
        shape = (config.hops, config.channels, structural + any(offered))
        weights = self.param("selection", nn.initializers.normal(0.01), shape, jnp.float32)
        if any(offered):
            weights = jnp.where(_choices(offered, structural), weights, -jnp.inf)
        mask, width = key_mask(valid.reshape(-1)), config.heads * config.head_dim
        query = key = None
        if any(offered):
            placed = x + position
            query, key = (_by_head(nn.Dense(width, name=name)(placed), config.heads) for name in ("query", "key"))

        def mix(hop, type_weights, h):
            by_structure = type_weights[:structural]
            mixed = mix_relations(config.relations, by_structure, h, valid) if structural else jnp.zeros_like(h)
            if not offered[hop] or query is None or key is None:
                return mixed
            here, _ = bordered_sides(config.relations, h, valid)
            here = _by_head(here.astype(query.dtype), config.heads)
            similar = masked_attention(query, key, here, mask, drop).swapaxes(0, 1).reshape(h.shape)
            # Invalid cells are queries too; their result must not enter a further hop.
            return mixed + type_weights[structural][None, None] * jnp.where(valid[..., None], similar, 0.0)

        if self.is_mutable_collection("intermediates"):
            self.sow("intermediates", "relations", nn.softmax(weights, -1))
            if query is not None and key is not None:
                self.sow("intermediates", "probabilities", attention_probabilities(query, key, mask))
        value = jnp.where(valid[..., None], full(nn.Dense(dim, name="value")(x)), 0.0)
        propagated = propagate(mix, weights, value)
        return nn.Dense(dim, name="output")(propagated)


class NeighbourConvolution(nn.Module):
    """ReLU(D^-1/2 (A + I) D^-1/2 x W), Kipf & Welling 2017, Eq. (2). It has no queries, so positions are unused."""

    @nn.compact
    def __call__(
        self, x: Float[Array, "h w c"], position: Float[Array, "h w c"], valid: Bool[Array, "h w"], drop: Drop = None
    ) -> Float[Array, "h w c"]:
        """Return the change of x, without the residual."""
        del position, drop
        if self.is_mutable_collection("intermediates"):
            self.sow("intermediates", "relations", jnp.ones((1, 1, 1), x.dtype))
        return nn.relu(smooth(full(nn.Dense(x.shape[-1], name="value")(x)), valid))


class HeterogeneousAttention(nn.Module):
    """Attention within the neighbourhoods of each meta-path, and attention over the meta-paths.

    A composed meta-path is the product of its edges' attention matrices, as the GTN composes: its rows sum to 1, and
    no product is formed. HAN takes one softmax over all end nodes of a path; for paths of one edge both are equal.
    """

    config: HanEncoderConfig

    @nn.compact
    def __call__(
        self, x: Float[Array, "h w c"], position: Float[Array, "h w c"], valid: Bool[Array, "h w"], drop: Drop = None
    ) -> Float[Array, "h w c"]:
        """Return the change of x, without the residual."""
        config, (height, width, dim) = self.config, x.shape
        # All cells are nodes of one type, hence one transformation (Wang et al. 2019, Eq. 1).
        transform = nn.Dense(dim, name="value")
        value = full(transform(x)).reshape(height, width, config.heads, dim // config.heads)
        placed = (x + position).reshape(height * width, dim)
        paths = [relation.split("+") for relation in config.relations]
        edges = sum(map(len, paths))
        # Scores are linear in features + position; HAN's, a^T [W h_i || W h_j] (Eq. 3), in the projected features.
        halves = nn.Dense(2 * edges * config.heads, use_bias=False, name="scores")(placed)
        scores = iter(jnp.moveaxis(full(halves).reshape(height, width, edges, 2, config.heads), (2, 3), (0, 1)))
        by_type = []
        for relation, path in zip(config.relations, paths, strict=True):
            out = value
            for edge in path:
                destination, source = next(scores)
                if edge == "near":
                    out, weights = attend_near(destination, source, out, valid, drop)
                else:
                    out, weights = attend_along(AXES[edge], destination, source, out, valid, drop)
                if self.is_mutable_collection("intermediates"):
                    self.sow("intermediates", f"{relation}_probabilities", weights)
            by_type.append(nn.elu(out.reshape(height, width, dim)))  # Eq. (4)
        # beta = softmax of mean_i q^T tanh(W z_i + b) (Eq. 7-9), over valid cells.
        summary, question = nn.Dense(config.semantic, name="semantic"), nn.Dense(1, use_bias=False, name="question")
        count = jnp.maximum(valid.sum(), 1).astype(x.dtype)
        asked = [jnp.where(valid, full(question(jnp.tanh(summary(z))))[..., 0], 0.0).sum() for z in by_type]
        type_weights = nn.softmax(jnp.stack(asked) / count)
        if self.is_mutable_collection("intermediates"):
            self.sow("intermediates", "relations", type_weights[None, None])
        return sum((type_weights[i] * z for i, z in enumerate(by_type)), jnp.zeros_like(x))


def _choices(offered: list[bool], structural: int) -> Bool[Array, "hops 1 e"]:
    """Return which edge types each hop may select: all structural ones, and similarity where offered."""
    return jnp.asarray([[[True] * structural + [similar]] for similar in offered])


def _by_head(x: Float[Array, "h w c"], heads: int) -> Float[Array, "heads n d"]:
    return x.reshape(x.shape[0] * x.shape[1], heads, x.shape[-1] // heads).swapaxes(0, 1)
