"""Parts of LaneSegNet's decoder (Li et al. 2024): attention regions and the heads of lane segments.

A lane segment is a centerline and an offset: left = center + offset, right = center - offset. Each attention head
samples around a point of its own on the two boundaries that the layer before predicted ("heads-to-regions").
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.layers.initial import uniform_by_fan_in
from tflane_jax.limits import Count, Limit, Rules, counted
from tflane_jax.models.lane_decoder import clipped, directions, refined_points, smooth_basis, spread_points
from tflane_jax.models.lane_queries import LaneDecoderConfig

LINE_TYPES = 3
"""As `scene.LineType`."""
# Half the width of a lane, metres: where the boundaries of `offsets="lane"` start.
_HALF_WIDTH = 1.75


@dataclass(frozen=True)
class SegmentDecoderConfig(LaneDecoderConfig):
    """Sizes and forms of the decoder. Sizes train on two CPU cores; `PAPER_SEGMENT_DECODER` has LaneSegNet's.

    Attributes:
        refine: "point": a segment starts at one point, a function of its query, and every layer moves all its points
            freely, as in LaneSegNet; "iterative": see `models.lane_decoder`.
        offsets: of the boundaries from the centerline. "ego": metres along x, y and z, as in LaneSegNet; "lane": along
            and across the centerline at each point, smooth along the lane, starting 1.75 m to either side.
        classes: 2: lane segment and crossing; 1: lane segment, where areas have a decoder of their own.
        initial_score: initial probability of the classes; None: PyTorch's initial biases, as in LaneSegNet.
        others: see `LaneDecoderConfig`; `sampling_points` is a multiple of 8 or less than 8, `heads` is even.
    """

    points: Annotated[int, counted(2)] = 10
    sampling_points: Count = 32
    refine: Literal["point", "iterative"] = "point"  # pyright: ignore[reportIncompatibleVariableOverride]
    offsets: Literal["ego", "lane"] = "ego"
    classes: Literal[1, 2] = 2
    initial_score: Annotated[float, Limit("above 0 and below 1", lambda value: 0 < value < 1)] | None = None

    def limits(self) -> Rules:
        """Those of every lane decoder, sampling points that split over directions, and an even number of heads."""
        yield from super().limits()
        star = self.sampling_points % min(self.sampling_points, 8) == 0
        yield "sampling_points", star, "a multiple of 8 or less than 8: they start as a star of eight directions"
        yield "heads", self.heads % 2 == 0, "even: half of the attention heads look at each boundary"


PAPER_SEGMENT_DECODER = SegmentDecoderConfig(dim=256, layers=6, queries=200, hidden=512, relation=128, dropout=0.1)


class SegmentOutput(NamedTuple):
    """Outputs of the heads of one decoder layer.

    Attributes:
        points, left, right: (Q, P, 3) metres.
        unit: `points` in [0, 1].
        logits: (Q, classes).
        left_type, right_type: (Q, 3) logits of the line types.
        mask: (Q, H, W) logits of the segment's area; None outside training.
    """

    points: Float[Array, "q p 3"]
    left: Float[Array, "q p 3"]
    right: Float[Array, "q p 3"]
    unit: Float[Array, "q p 3"]
    logits: Float[Array, "q c"]
    left_type: Float[Array, "q t"]
    right_type: Float[Array, "q t"]
    mask: Float[Array, "q h w"] | None


class SegmentHeads(nn.Module):
    """Class, centerline, offset, line types and mask of one decoder layer.

    Attributes:
        config: sizes and forms.
        range: the box that normalised coordinates span.
        limits: the box at whose border lanes end, output "metric" only.
    """

    config: SegmentDecoderConfig
    range: PerceptionRange
    limits: PerceptionRange | None = None

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "q c"],
        reference: Float[Array, "q p 3"],
        bev: Float[Array, "h w e"],
        *,
        masks: bool = False,
    ) -> SegmentOutput:
        """Return the layer's prediction; `masks`: with the logits of the areas."""
        config, hidden, lines = self.config, (self.config.dim,) * 2, self.config.points * 3
        score = config.initial_score
        bias = None if score is None else math.log(score / (1.0 - score))
        logits = Branch((*hidden, config.classes), norm=True, bias=bias, name="class")(queries)
        left_type, right_type = (
            Branch((*hidden, LINE_TYPES), norm=True, name=f"{side}_type")(queries) for side in ("left", "right")
        )
        change, offset = (
            Branch((*hidden, lines), name=name)(queries).reshape(reference.shape) for name in ("points", "offset")
        )
        unit = refined_points(config, self.range, self.limits, change, reference, queries, bev)
        points = self.range.denormalise(unit)
        left, right = self._boundaries(points, offset)
        mask = None
        if masks:
            kernels = Branch((*hidden, bev.shape[-1]), name="mask")(queries)
            mask = jnp.einsum("qe,hwe->qhw", kernels, bev)
        return SegmentOutput(points, left, right, unit, logits, left_type, right_type, mask)

    def _boundaries(
        self, points: Float[Array, "q p 3"], offset: Float[Array, "q p 3"]
    ) -> tuple[Float[Array, "q p 3"], Float[Array, "q p 3"]]:
        """Return left and right boundary, metres."""
        config = self.config
        if config.offsets == "lane":
            offset = jnp.einsum("pk,qkc->qpc", smooth_basis(config.points), offset, precision="highest")
            along, across, up = jnp.moveaxis(offset, -1, 0)
            heading = jax.lax.stop_gradient(directions(points[..., :2]))
            across = across + _HALF_WIDTH
            cos, sin = heading[..., 0], heading[..., 1]
            offset = jnp.stack([cos * along - sin * across, sin * along + cos * across, up], -1)
        both = points + offset, points - offset
        if config.output == "sigmoid":
            return both
        left, right = (
            self.range.denormalise(clipped(self.range.normalise(line), self.range, self.limits)) for line in both
        )
        return left, right


def regions(
    left: Float[Array, "q p 3"], right: Float[Array, "q p 3"], config: SegmentDecoderConfig
) -> Float[Array, "q r 2"]:
    """Return the reference point (x, y) of each head: half of the heads along either boundary."""
    along = spread_points(config.points, config.heads // 2)
    return jnp.concatenate([left[:, along, :2], right[:, along, :2]], 1)


class Branch(nn.Module):
    """Linear layers with ReLU, or layer norm and ReLU, between them, initialised as in PyTorch.

    Attributes:
        widths: output channels of each layer.
        norm: whether there are layer norms.
        bias: initial bias of the last layer; None: as in PyTorch.
    """

    widths: tuple[int, ...]
    norm: bool = False
    bias: float | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b d"]:
        """Return the last layer's output, without activation."""
        for i, width in enumerate(self.widths):
            init, last = uniform_by_fan_in(x.shape[-1]), i == len(self.widths) - 1
            bias = nn.initializers.constant(self.bias) if last and self.bias is not None else init
            x = nn.Dense(width, kernel_init=init, bias_init=bias, name=f"linear_{i}")(x)
            if not last:
                x = nn.relu(nn.LayerNorm(epsilon=1e-5, name=f"norm_{i}")(x) if self.norm else x)
        return x
