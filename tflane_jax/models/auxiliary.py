"""Auxiliary outputs: outputs of a model that only auxiliary losses read."""

from __future__ import annotations

from typing import Any, Literal

import flax.linen as nn
from flax import struct
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Float

from tflane_jax.layers.initial import uniform_by_fan_in
from tflane_jax.scene import CenterlinePrediction, LinePrediction, SegmentPrediction

AUXILIARY = "auxiliary"
"""Collection of auxiliary outputs. A model computes them only where a caller makes the collection mutable."""

CELL_CHANNELS = 5
"""Channels per BEV cell: occupancy logit, offset to the nearest lane in cells (2), direction of that lane (2)."""

AuxiliaryName = Literal[
    "denoised",
    "lane_cells",
    "lane_proposals",
    "line_cells",
    "one_to_many",
    "line_mask",
    "view_line_masks",
    "depth",
]


@struct.dataclass
class LaneProposalOutputs:
    """Heat map and shapes of lane proposals.

    Attributes:
        heat: (h, w, K) logits: is there the middle of a lane in this cell, with a heading in this bin?
        lanes: (N, P, 3) metres, the shapes proposed near the middle of each true lane.
    """

    heat: Float[Array, "*b h w k"]
    lanes: Float[Array, "*b n p 3"]


@struct.dataclass
class AuxiliaryOutputs:
    """Auxiliary outputs of a model; None where it has none. `HostConfig.auxiliary` lists those of a host.

    Attributes:
        denoised: centerlines, segments or map lines of the denoising queries, leading axes (copy, layer); see
            `models.lane_denoising`.
        lane_cells: (h, w, `CELL_CHANNELS`) lanes per BEV cell.
        lane_proposals: of the heads that propose lanes, see `models.lane_proposals`.
        line_cells: (h, w) logit per cell of the image features: does a lane line pass through it?
        one_to_many: map lines of MapTRv2's second group of queries, leading axis layer.
        line_mask: (h, w) logit per BEV cell: does a map line pass through it?
        view_line_masks: (V, h, w) the same of the image cells of V cameras.
        depth: (V, h, w, D) logits of the depth bins of image cells, see `models.lift`.
    """

    denoised: CenterlinePrediction | SegmentPrediction | LinePrediction | None = None
    lane_cells: Float[Array, "*b h w c"] | None = None
    lane_proposals: LaneProposalOutputs | None = None
    line_cells: Float[Array, "*b h w"] | None = None
    one_to_many: LinePrediction | None = None
    line_mask: Float[Array, "*b h w"] | None = None
    view_line_masks: Float[Array, "*b v h w"] | None = None
    depth: Float[Array, "*b v h w d"] | None = None


def auxiliary_outputs(state: Any) -> AuxiliaryOutputs:
    """Return the auxiliary outputs from the mutated collections that `Module.apply` returns."""
    flat: Any = flatten_dict(state.get(AUXILIARY, {}))
    # `sow` appends to a tuple.
    return AuxiliaryOutputs(**{path[-1]: values[0] for path, values in flat.items()})


class LaneCellHead(nn.Module):
    """Predicts the auxiliary output `lane_cells` from BEV features."""

    @nn.compact
    def __call__(self, bev: Float[Array, "h w c"]) -> None:
        """Sow the prediction for each BEV cell. No-op unless the `auxiliary` collection is mutable."""
        if self.is_mutable_collection(AUXILIARY):
            self.sow(AUXILIARY, "lane_cells", nn.Dense(CELL_CHANNELS, name="out")(bev))


class LineMaskHead(nn.Module):
    """Whether any line passes through a cell, from features of the cells; initialised as in PyTorch."""

    @nn.compact
    def __call__(self, features: Float[Array, "*v h w c"]) -> Float[Array, "*v h w"]:
        """Return the logit of each cell."""
        channels = features.shape[-1]
        hidden, out = uniform_by_fan_in(9 * channels), uniform_by_fan_in(channels)
        x = nn.relu(nn.Conv(channels, (3, 3), use_bias=False, kernel_init=hidden, name="hidden")(features))
        return nn.Conv(1, (1, 1), kernel_init=out, bias_init=out, name="out")(x)[..., 0]
