"""Loss of OpenLane-V2's large baseline: TopoNet's terms, on Bezier control points (docs/reference/toponet.md)."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Array, Float

from tflane_jax.limits import PositiveOrZero
from tflane_jax.losses.common import Report
from tflane_jax.losses.toponet import TopoNetLossConfig, lane_graph_host_loss
from tflane_jax.models.auxiliary import AuxiliaryOutputs
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.scene import Example, Prediction


@dataclass(frozen=True)
class BevFormerDetrLossConfig(TopoNetLossConfig):
    """Weights, see `TopoNetLossConfig`; the defaults are the baseline's."""

    points_weight: PositiveOrZero = 0.0075

    def loss(
        self, outputs: Prediction, auxiliary: AuxiliaryOutputs, batch: Example, host: BevFormerDetrConfig
    ) -> tuple[Float[Array, ""], Report]:
        """Return the loss of a batch and the numbers to record, see `HostLossConfig.loss`.

        Lanes are compared by the host's number of control points; by their points if it predicts points.
        """
        return lane_graph_host_loss(self, outputs, auxiliary, batch, host, host.control_points)
