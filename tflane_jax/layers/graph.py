"""TopoNet's scene graph: message passing between lanes, and the heads that predict its edges (specs section 5).

The edges that a layer passes messages along are the previous layer's own predictions, as probabilities without
gradient. Rows index lanes; [i, j] means that lane j continues lane i.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class LaneGraphConvolution(nn.Module):
    """Lane-to-lane message passing: x W + e (A x W_f) + e (A^T x W_b), without normalisation.

    Attributes:
        dim: channels out.
        edge_weight: e, the share of neighbours (TopoNet: 0.6).
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


class SceneGraphFeedForward(nn.Module):
    """FFN_SGNN: a feed-forward block whose output passes through the scene graph.

    The element-to-lane half of TopoNet joins the lane half before `downsample`; without traffic elements (this host
    so far) only the lane half is there.

    Attributes:
        dim: channels.
        hidden: channels inside the feed-forward part.
        edge_weight: see `LaneGraphConvolution`.
    """

    dim: int
    hidden: int
    edge_weight: float = 0.6

    @nn.compact
    def __call__(self, x: Float[Array, "q c"], adjacency: Float[Array, "q q"]) -> Float[Array, "q c"]:
        """Return x plus what the block adds."""
        # The reference applies ReLU after the second linear as well (specs section 15, item 7).
        features = nn.relu(nn.Dense(self.hidden, name="expand")(x))
        features = nn.relu(nn.Dense(self.dim, name="contract")(features))
        lanes = LaneGraphConvolution(self.dim, self.edge_weight, name="lane_lane")(features, adjacency)
        return x + nn.Dense(self.dim, name="downsample")(nn.relu(lanes))


class RelationshipHead(nn.Module):
    """Scores every ordered pair of two sets: an MLP for each side, then an MLP on the joined pair.

    The first pair layer acts on [a_i | b_j]; it is computed as U a_i + V b_j, which is the same and never builds
    the joined (A, B, 2 hidden) array.

    Attributes:
        hidden: channels of a side after its MLP (TopoNet: 128), twice that in the pair MLP.
    """

    hidden: int = 128

    @nn.compact
    def __call__(self, a: Float[Array, "a c"], b: Float[Array, "b c"]) -> Float[Array, "a b"]:
        """Return a logit for each pair."""
        a = Mlp((a.shape[-1], a.shape[-1], self.hidden), name="mlp_first")(a)
        b = Mlp((b.shape[-1], b.shape[-1], self.hidden), name="mlp_second")(b)
        width = 2 * self.hidden
        first = nn.Dense(width, name="pair_first")(a)
        second = nn.Dense(width, use_bias=False, name="pair_second")(b)
        pair = nn.relu(first[:, None] + second[None, :])
        pair = nn.relu(nn.Dense(width, name="pair_hidden")(pair))
        return nn.Dense(1, name="pair_out")(pair)[..., 0]


class Mlp(nn.Module):
    """Linear layers with ReLU between them.

    Attributes:
        widths: output channels of each layer.
    """

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b d"]:
        """Return the last layer's output, without activation."""
        for i, width in enumerate(self.widths):
            x = nn.Dense(width, name=f"linear_{i}")(x if i == 0 else jax.nn.relu(x))
        return x


def edge_probabilities(logits: Float[Array, "a b"]) -> Float[Array, "a b"]:
    """Return the probabilities of edges for the next layer's messages; no gradient flows through them."""
    return jax.lax.stop_gradient(jax.nn.sigmoid(logits.astype(jnp.float32))).astype(logits.dtype)
