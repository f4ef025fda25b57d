"""TopoNet's scene graph: messages between lanes and from traffic elements to lanes, and the heads that predict edges.

Reference: TopoNet (Li et al. 2023) and its published code. The edges of a layer are the previous layer's predictions,
as probabilities without gradient. Rows index lanes; [i, j] means that lane j continues lane i, or that element j
governs lane i.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float


@struct.dataclass
class ElementNodes:
    """Traffic elements as nodes of the scene graph.

    Attributes:
        features: (E, C), embedded for the lane decoder.
        logits: (E, K) by class (sigmoid); no gradient flows through them.
        edges: (Q, E) probability that element e governs lane q.
    """

    features: Float[Array, "e c"]
    logits: Float[Array, "e k"]
    edges: Float[Array, "q e"]


class LaneGraphConvolution(nn.Module):
    """Lane-to-lane message passing: x W + e (A x W_f) + e (A^T x W_b), without normalisation.

    Attributes:
        dim: channels out.
        edge_weight: e, the weight of neighbours (TopoNet: 0.6).
    """

    dim: int
    edge_weight: float = 0.6

    @nn.compact
    def __call__(self, x: Float[Array, "q c"], adjacency: Float[Array, "q q"]) -> Float[Array, "q d"]:
        """Return the features after one exchange along `adjacency` (probabilities of i -> j)."""
        linear = lambda name: nn.Dense(self.dim, use_bias=False, name=name)(x)  # noqa: E731
        onward = adjacency @ linear("forward")
        backward = adjacency.T @ linear("backward")
        return linear("own") + self.edge_weight * (onward + backward)


class ElementGraphConvolution(nn.Module):
    """Element-to-lane messages with a matrix of its own for each class (TopoNet's scene knowledge graph).

    (e B) sum_k S[:, k] (T W_k), S the probabilities of the classes, B those of the edges.

    Attributes:
        dim: channels out.
        edge_weight: e.
    """

    dim: int
    edge_weight: float = 0.6

    @nn.compact
    def __call__(self, elements: ElementNodes) -> Float[Array, "q d"]:
        """Return the sum of messages to every lane."""
        (_, c), classes = elements.features.shape, elements.logits.shape[-1]
        init = nn.initializers.xavier_uniform(batch_axis=0)
        kernel = self.param("kernel", init, (classes, c, self.dim), jnp.float32)
        probability = nn.sigmoid(lax.stop_gradient(elements.logits))
        support = jnp.einsum("ek,ec,kcd->ed", probability, elements.features, kernel)
        return self.edge_weight * (elements.edges @ support)


class SceneGraphFeedForward(nn.Module):
    """FFN_SGNN: a feed-forward block whose output passes through the scene graph.

    Messages from lanes and, if there are any, from traffic elements are concatenated before `downsample`.

    Attributes:
        dim: channels.
        hidden: channels inside the feed-forward part.
        edge_weight: see `LaneGraphConvolution`.
        dropout: probability for hidden channels, messages and the residual branch.
    """

    dim: int
    hidden: int
    edge_weight: float = 0.6
    dropout: float = 0.0

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "q c"],
        adjacency: Float[Array, "q q"],
        elements: ElementNodes | None = None,
        *,
        deterministic: bool = True,
    ) -> Float[Array, "q c"]:
        """Return x plus the block's output."""
        drop = lambda name, y: nn.Dropout(self.dropout, name=name)(y, deterministic=deterministic)  # noqa: E731
        # TopoNet's code applies ReLU after the second linear layer as well.
        features = drop("expand_dropout", nn.relu(nn.Dense(self.hidden, name="expand")(x)))
        features = drop("contract_dropout", nn.relu(nn.Dense(self.dim, name="contract")(features)))
        received = LaneGraphConvolution(self.dim, self.edge_weight, name="lane_lane")(features, adjacency)
        if elements is not None:
            along = ElementGraphConvolution(self.dim, self.edge_weight, name="lane_element")(elements)
            received = jnp.concatenate([received, along], -1)
        received = drop("received_dropout", nn.relu(received))
        return x + drop("downsample_dropout", nn.Dense(self.dim, name="downsample")(received))


class RelationshipHead(nn.Module):
    """Scores every ordered pair of two sets: an MLP for each side, then an MLP on the joined pair.

    The first pair layer acts on [a_i | b_j]. It is computed as U a_i + V b_j, which is equal and never builds the
    (A, B, 2 hidden) array.

    Attributes:
        hidden: channels of a side after its MLP (TopoNet: 128), twice that in the pair MLP.
    """

    hidden: int = 128

    @nn.compact
    def __call__(self, a: Float[Array, "a c"], b: Float[Array, "b c"]) -> Float[Array, "a b"]:
        """Return a logit for each pair."""
        dtype = a.dtype
        a = Mlp((a.shape[-1], a.shape[-1], self.hidden), name="mlp_first")(a)
        b = Mlp((b.shape[-1], b.shape[-1], self.hidden), name="mlp_second")(b)
        width = 2 * self.hidden
        first = nn.Dense(width, name="pair_first")(a)
        second = nn.Dense(width, use_bias=False, name="pair_second")(b)
        pair = nn.relu(first[:, None] + second[None, :])
        pair = nn.relu(nn.Dense(width, name="pair_hidden")(pair))
        # In the type that came in, float32, also if the layers compute in bfloat16: with its 8 bits, many pairs would
        # have the same score.
        return nn.Dense(1, dtype=dtype, name="pair_out")(pair)[..., 0]


class Mlp(nn.Module):
    """Linear layers with ReLU between them.

    Attributes:
        widths: output channels of each layer.
        kernel_init: of every layer.
    """

    widths: tuple[int, ...]
    kernel_init: nn.initializers.Initializer = nn.initializers.lecun_normal()

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b d"]:
        """Return the last layer's output, without activation."""
        for i, width in enumerate(self.widths):
            layer = nn.Dense(width, kernel_init=self.kernel_init, name=f"linear_{i}")
            x = layer(x if i == 0 else jax.nn.relu(x))
        return x


def edge_probabilities(logits: Float[Array, "a b"]) -> Float[Array, "a b"]:
    """Return the probabilities of edges for the next layer's messages; no gradient flows through them."""
    return lax.stop_gradient(jax.nn.sigmoid(logits.astype(jnp.float32))).astype(logits.dtype)
