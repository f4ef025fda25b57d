"""Graph Transformer Networks: soft selection of edge types, and graph convolution on the meta-paths they form.

Yun et al. 2019 (GTN), its sparse revision and FastGTN (both 2022) as options of the same functions; shared
specs/modules.md section 10, GTN lane paper section 2.1. A stack of adjacency matrices (e, n, n) holds one edge type
each. An edge points from a sender to a receiver: `receivers` says which of the two the rows are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

Receivers = Literal["rows", "columns"]
Loops = Literal["kept", "removed", "lonely"]

_selection_init = nn.initializers.normal(0.01)


@dataclass(frozen=True)
class GtnVariant:
    """What the published versions of the dense network do differently.

    Attributes:
        receivers: the axis of an adjacency that hears; its weights sum to 1 after normalisation.
        loops: edges from a node to itself in a meta-path graph: `kept` or `removed` before normalisation.
        normalise_last: normalise behind the last layer too, not only between layers.
        own: weight of a node's own features in the convolution, instead of removed loops or added to kept ones.
        bias: the convolution has one.
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
        loops: `kept`, `removed`, or `lonely`: added where a node has no edge into it, the limit of FastGTN's 1e-20 I.
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

    The first layer multiplies two selections, every further layer what it gets and one more.
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


def propagate(
    mix: Callable[[int, Float[Array, "e d"], Float[Array, "*n d"]], Float[Array, "*n d"]],
    weights: Float[Array, "hops c e"],
    x: Float[Array, "*n d"],
) -> Float[Array, "*n d"]:
    """Return ... Q_2 (Q_1 x): the mixtures of Eq. (1) one after the other, without a product of adjacencies.

    By associativity this is convolution on the meta-path graph ... Q_2 Q_1 (FastGTN). Where the edges into every node
    sum to 1 in each edge type, they do so in the product, which needs no normalisation.

    Args:
        mix: returns sum_e share_e A_e x of a hop, from its number, the shares and x; how the A_e are stored is its
            affair.
        weights: W of Eq. (1) by hop; -inf for an edge type that a hop may not choose.
        x: the channels' features side by side, d a multiple of c.
    """
    shares = jnp.repeat(nn.softmax(weights, -1), x.shape[-1] // weights.shape[1], axis=1).swapaxes(1, 2)
    for hop, of_hop in enumerate(shares):
        x = mix(hop, of_hop, x)
    return x


class GraphTransformer(nn.Module):
    """GTN with dense products: meta-path graphs, and one graph convolution shared by all of them.

    Attributes:
        dim: features out of each channel.
        channels: meta-path graphs.
        layers: products of adjacencies; paths are one edge longer.
        variant: which published version.
    """

    dim: int
    channels: int = 2
    layers: int = 2
    variant: GtnVariant = GTN_2022

    @nn.compact
    def __call__(self, adjacency: Float[Array, "e n n"], x: Float[Array, "n d"]) -> Float[Array, "n f"]:
        """Return the channels' node features side by side, f = channels * dim."""
        weights = self.param("selection", _selection_init, (self.layers + 1, self.channels, adjacency.shape[0]))
        graphs = meta_path_graphs(adjacency, weights, self.variant)
        out = convolve(graphs, nn.Dense(self.dim, use_bias=False, name="convolution")(x), self.variant)
        if self.variant.bias:
            out = out + self.param("bias", nn.initializers.zeros_init(), (self.dim,))[None, None]
        return nn.relu(out).swapaxes(0, 1).reshape(x.shape[0], self.channels * self.dim)


class FastGraphTransformer(nn.Module):
    """One block of FastGTN: each channel projects the features and sends them along its own soft meta-path.

    Attributes:
        dim: features out.
        channels: meta-paths.
        hops: edges of a meta-path.
        beta: share of the projected features themselves.
        aggregate: `mean` over the channels, or `concat` and a linear layer with ReLU.
    """

    dim: int
    channels: int = 2
    hops: int = 2
    beta: float = 0.0
    aggregate: Literal["mean", "concat"] = "mean"

    @nn.compact
    def __call__(self, adjacency: Float[Array, "e n n"], x: Float[Array, "n d"]) -> Float[Array, "n f"]:
        """Return the node features, f = dim; `adjacency` has receivers as rows, which sum to 1."""
        weights = self.param("selection", _selection_init, (self.hops, self.channels, adjacency.shape[0]))
        projected = nn.Dense(self.channels * self.dim, use_bias=False, name="projection")(x)
        heard = propagate(lambda _, shares, h: (shares[:, None] * (adjacency @ h)).sum(0), weights, projected)
        out = nn.relu(self.beta * projected + (1.0 - self.beta) * heard)
        if self.aggregate == "mean":
            return out.reshape(x.shape[0], self.channels, self.dim).mean(1)
        return nn.relu(nn.Dense(self.dim, name="joined")(out))


def _identity(graphs: Float[Array, "c n n"]) -> Float[Array, "1 n n"]:
    return jnp.eye(graphs.shape[-1], dtype=graphs.dtype)[None]


def _without_loops(graphs: Float[Array, "c n n"]) -> Float[Array, "c n n"]:
    return graphs * (1.0 - _identity(graphs))
