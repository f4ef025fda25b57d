"""What models predict; a part that a model does not predict is None."""

from __future__ import annotations

import jax
from flax import struct
from jaxtyping import Float

from tflane_jax.scene.arrays import Array


@struct.dataclass
class LanePrediction:
    """Lanes predicted by Q queries.

    Attributes:
        points: (Q, P, 3) metres, ego frame, in driving direction.
        logits: (Q, C) class logits (sigmoid); C = 1 for centerlines.
        successor_logits: (Q, Q) [i, j]: lane j continues lane i.
    """

    points: Float[Array, "*layers q p 3"]
    logits: Float[Array, "*layers q c"]
    successor_logits: Float[Array, "*layers q q"]

    @property
    def scores(self) -> Float[Array, "*layers q"]:
        """Confidence of the best class, 0 to 1."""
        return jax.nn.sigmoid(self.logits).max(-1)


@struct.dataclass
class ElementPrediction:
    """Traffic lights and signs predicted by E queries in the front image.

    Attributes:
        box: (E, 2, 2) top-left and bottom-right corners, pixels of camera 0.
        logits: (E, 13) by OpenLane-V2 attribute (sigmoid).
        lane_logits: (Q, E) [i, e]: element e governs lane i of the `LanePrediction` beside it.
    """

    box: Float[Array, "*layers e 2 2"]
    logits: Float[Array, "*layers e a"]
    lane_logits: Float[Array, "*layers q e"]


@struct.dataclass
class Prediction:
    """What a model says about one frame; a part that the model does not predict is None."""

    lanes: LanePrediction | None = None
    elements: ElementPrediction | None = None


@struct.dataclass
class LaneShapePrediction:
    """Lane lines predicted by Q queries as parameters of the lane shape model (GTN paper, Eq. 7 and 8).

    Attributes:
        logits: (Q, 2) class logits (softmax), index 1 is a lane.
        curves: (Q, 8) lower and upper end (alpha, beta: rows v), k'', f'', m'', n', b'', b''' in shares of the image.
    """

    logits: Float[Array, "*layers q 2"]
    curves: Float[Array, "*layers q 8"]
