"""Outputs of a model that auxiliary losses alone look at."""

from __future__ import annotations

from typing import Any, Literal

import flax.linen as nn
from flax import struct
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Float

from tflane_jax.scene import CenterlinePrediction

AUXILIARY = "auxiliary"
"""Collection of auxiliary outputs. A model computes them only where a caller makes the collection mutable."""

CELL_CHANNELS = 5
"""Channels per BEV cell: occupancy logit, offset to the nearest lane in cells (2), direction of that lane (2)."""

AuxiliaryName = Literal["denoised", "lane_cells", "line_cells"]


@struct.dataclass
class AuxiliaryOutputs:
    """What a model gives to its auxiliary losses; a host says in `auxiliary` which of them it has.

    Attributes:
        denoised: centerlines of the denoising queries, leading axes (copy, layer).
        lane_cells: (h, w, `CELL_CHANNELS`) lanes by BEV cell.
        line_cells: (h, w) logit that a lane line passes through a cell of the image features.
    """

    denoised: CenterlinePrediction | None = None
    lane_cells: Float[Array, "*b h w c"] | None = None
    line_cells: Float[Array, "*b h w"] | None = None


def auxiliary_outputs(state: Any) -> AuxiliaryOutputs:
    """Return the auxiliary outputs among the variables that `Module.apply` changed."""
    flat: Any = flatten_dict(state.get(AUXILIARY, {}))
    # Flax keeps what is sown in a tuple.
    return AuxiliaryOutputs(**{path[-1]: values[0] for path, values in flat.items()})


class LaneCellHead(nn.Module):
    """Predicts lanes by BEV cell as the auxiliary output `lane_cells`."""

    @nn.compact
    def __call__(self, bev: Float[Array, "h w c"]) -> None:
        """Predict from BEV features. No-op unless the `auxiliary` collection is mutable."""
        if self.is_mutable_collection(AUXILIARY):
            self.sow(AUXILIARY, "lane_cells", nn.Dense(CELL_CHANNELS, name="out")(bev))
