"""The published Graph Transformer Networks: soft selection of edge types, and graph convolution on their meta-paths.

Graph Transformer Networks (Yun et al. 2019), their sparse revision and FastGTN (Yun et al. 2022) are options of the
same functions; equation numbers are those of the GTN lane paper, section 2.1. A stack of adjacency matrices (e, n, n)
holds one edge type per matrix. An edge points from a source to a destination node: `receivers` says whether rows or
columns are the destinations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from tflane_jax.layers.graph import Mlp
from tflane_jax.layers.graph_transformer import propagate

Receivers = Literal["rows", "columns"]
Loops = Literal["kept", "removed", "lonely"]

_selection_init = nn.initializers.normal(0.01)


@dataclass(frozen=True)
class GtnVariant:
    """Differences between the published versions of the dense network.

    Attributes:
        receivers: axis of the destination nodes; the edges into each of them sum to 1 after normalisation.
        loops: self-loops of a meta-path graph: `kept` or `removed` before normalisation.
        normalise_last: normalise after the last layer too, not only between layers.
        own: weight of the identity that the convolution adds: it replaces removed loops, and adds to kept ones. The
            sparse revision's `remove_self_loops` is 0, which leaves the loops of meta-paths as they are.
        bias: the convolution has a bias.
    """

    receivers: Receivers = "rows"
    loops: Literal["kept", "removed"] = "kept"
    normalise_last: bool = True
    own: float = 1.0
    bias: bool = True


GTN_2019 = GtnVariant(receivers="columns", loops="removed", normalise_last=False, bias=False)
GTN_2022 = GtnVariant()


def select(adjacency: Float[Array, "e n n"], weights: Float[Array, "c e"]) -> Float[Array, "c n n"]:
    """Return Q = F(A; W) = phi(A; softmax(W)), Eq. (1): for each channel a convex mixture of the edge types."""
    return jnp.einsum("ce,enm->cnm", nn.softmax(weights, -1), adjacency)


def normalise(
    graphs: Float[Array, "c n n"], receivers: Receivers = "rows", loops: Loops = "kept"
) -> Float[Array, "c n n"]:
    """Return D^-1 A: the edges into each node sum to 1.

    A node without edges into it keeps none, with a gradient of 0 (the reference's is NaN).

    Args:
        graphs: non-negative.
        receivers: see `GtnVariant`.
        loops: `kept`, `removed`, or `lonely`: a self-loop for each node without incoming edges, which is the limit of
            FastGTN's 1e-20 I.
    """
    axis = -1 if receivers == "rows" else -2
    if loops == "removed":
        graphs = _without_loops(graphs)
    total = graphs.sum(axis, keepdims=True)
    some = total > 0
    graphs = graphs * jnp.where(some, 1.0 / jnp.where(some, total, 1.0), 0.0)
    return jnp.where(some, graphs, _identity(graphs)) if loops == "lonely" else graphs


def meta_path_graphs(
    adjacency: Float[Array, "e n n"], weights: Float[Array, "k c e"], variant: GtnVariant = GTN_2022
) -> Float[Array, "c n n"]:
    """Return the graphs of meta-paths of length k: Q_1 Q_2 Q_3 ..., normalised between the layers.

    The first layer multiplies two selections; each further layer multiplies its input with one more.
    """
    graphs, *others = (select(adjacency, w) for w in weights)
    for i, selection in enumerate(others):
        if i > 0:
            graphs = normalise(graphs, variant.receivers, variant.loops)
        graphs = graphs @ selection
    return normalise(graphs, variant.receivers, variant.loops) if variant.normalise_last else graphs


def convolve(
    graphs: Float[Array, "c n n"], x: Float[Array, "n d"], variant: GtnVariant = GTN_2022
) -> Float[Array, "c n d"]:
    """Return D^-1 (A + own I) x on each graph: the graph convolution, without its weight."""
    own = variant.own * _identity(graphs)
    graphs = (_without_loops(graphs) if variant.loops == "removed" else graphs) + own
    along = "cnm,md->cnd" if variant.receivers == "rows" else "cmn,md->cnd"
    return jnp.einsum(along, normalise(graphs, variant.receivers), x)


class GraphTransformer(nn.Module):
    """GTN with dense products: meta-path graphs, and one graph convolution shared by all of them.

    Attributes:
        dim: features out of each channel.
        channels: meta-path graphs.
        layers: products of adjacencies; paths are one edge longer.
        variant: the published version.
    """

    dim: int
    channels: int = 2
    layers: int = 2
    variant: GtnVariant = GTN_2022

    @nn.compact
    def __call__(self, adjacency: Float[Array, "e n n"], x: Float[Array, "n d"]) -> Float[Array, "n f"]:
        """Return the node features of all channels side by side, f = channels * dim."""
        weights = self.param(
            "selection", _selection_init, (self.layers + 1, self.channels, adjacency.shape[0]), jnp.float32
        )
        graphs = meta_path_graphs(adjacency, weights, self.variant)
        out = convolve(graphs, nn.Dense(self.dim, use_bias=False, name="convolution")(x), self.variant)
        if self.variant.bias:
            out = out + self.param("bias", nn.initializers.zeros_init(), (self.dim,), jnp.float32)[None, None]
        return nn.relu(out).swapaxes(0, 1).reshape(x.shape[0], self.channels * self.dim)


class FastGraphTransformer(nn.Module):
    """One block of FastGTN: each channel projects the features and propagates them along its own soft meta-path.

    Attributes:
        dim: features out.
        channels: meta-paths.
        hops: edges of a meta-path.
        beta: weight of the projected features themselves; the propagated ones have 1 - beta.
        aggregate: `mean` over the channels, or `concat` and a linear layer with ReLU.
        non_local: incoming edges of each node in FastGTN's non-local graph, which every hop derives from its input and
            mixes in as a last edge type; None for no such graph.
    """

    dim: int
    channels: int = 2
    hops: int = 2
    beta: float = 0.0
    aggregate: Literal["mean", "concat"] = "mean"
    non_local: int | None = None

    @nn.compact
    def __call__(self, adjacency: Float[Array, "e n n"], x: Float[Array, "n d"]) -> Float[Array, "n f"]:
        """Return the node features, f = dim; `adjacency` has receivers as rows, which sum to 1."""
        types = adjacency.shape[0] + (self.non_local is not None)
        weights = self.param("selection", _selection_init, (self.hops, self.channels, types), jnp.float32)
        projected = nn.Dense(self.channels * self.dim, use_bias=False, name="projection")(x)

        def mix(hop, by_type, h):
            graphs = adjacency
            if self.non_local is not None:
                mean = h.reshape(x.shape[0], self.channels, self.dim).mean(1)
                similar = NonLocalGraph(self.non_local, name=f"non_local_{hop}")(mean)
                graphs = jnp.concatenate([adjacency, similar[None]])
            return (by_type[:, None] * (graphs @ h)).sum(0)

        propagated = propagate(mix, weights, projected)
        out = nn.relu(self.beta * projected + (1.0 - self.beta) * propagated)
        if self.aggregate == "mean":
            return out.reshape(x.shape[0], self.channels, self.dim).mean(1)
        return nn.relu(nn.Dense(self.dim, name="joined")(out))


class NonLocalGraph(nn.Module):
    """FastGTN's non-local graph: edges into each node from the nodes whose features are most similar.

    Attributes:
        nearest: edges into each node; all nodes where there are no more.
        widths: channels of the MLP that features pass before they are compared.
    """

    nearest: int
    widths: tuple[int, ...] = (128, 64)

    @nn.compact
    def __call__(self, x: Float[Array, "n d"]) -> Float[Array, "n n"]:
        """Return the adjacency, destinations as rows: a softmax over the largest inner products of each row."""
        features = nn.relu(Mlp(self.widths, name="features")(x))
        similarity, source = lax.top_k(features @ features.T, min(self.nearest, x.shape[0]))
        destination = jnp.arange(x.shape[0])[:, None]
        return jnp.zeros((x.shape[0], x.shape[0]), x.dtype).at[destination, source].set(nn.softmax(similarity, -1))


def _identity(graphs: Float[Array, "c n n"]) -> Float[Array, "1 n n"]:
    return jnp.eye(graphs.shape[-1], dtype=graphs.dtype)[None]


def _without_loops(graphs: Float[Array, "c n n"]) -> Float[Array, "c n n"]:
    return graphs * (1.0 - _identity(graphs))
