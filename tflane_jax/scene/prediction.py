"""Predictions for one frame; a part that a model does not predict is None.

Arrays may have a leading axis over decoder layers (`*layers`); without it, they are the last layer's.
"""

from __future__ import annotations

import jax
from flax import struct
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.scene.arrays import Array


def best_confidence(logits: Float[Array, "*b c"]) -> Float[Array, "*b"]:
    """Return the confidence of the best class, 0 to 1: of independent classes, so each has its own sigmoid."""
    return jax.nn.sigmoid(logits).max(-1)


@struct.dataclass
class CenterlinePrediction:
    """Centerlines predicted by Q queries.

    Attributes:
        points: (Q, P, 3) metres, ego frame, in driving direction.
        logits: (Q, C) class logits (sigmoid); C = 1 for OpenLane-V2.
        successor_logits: (Q, Q) [i, j]: lane j continues lane i; None for a model without topology.
    """

    points: Float[Array, "*layers q p 3"]
    logits: Float[Array, "*layers q c"]
    successor_logits: Float[Array, "*layers q q"] | None = None

    @property
    def scores(self) -> Float[Array, "*layers q"]:
        """Confidence of the best class, 0 to 1."""
        return best_confidence(self.logits)


@struct.dataclass
class AreaPrediction:
    """Pedestrian crossings and road boundaries predicted by Q queries of their own.

    Attributes:
        points: (Q, P, 3) metres, ego frame; a ring repeats its first point at the end.
        logits: (Q, 2) class logits (sigmoid): pedestrian crossing, road boundary, as `AreaType` orders them.
    """

    points: Float[Array, "*layers q p 3"]
    logits: Float[Array, "*layers q 2"]

    @property
    def scores(self) -> Float[Array, "*layers q"]:
        """Confidence of the best class, 0 to 1."""
        return best_confidence(self.logits)


@struct.dataclass
class SegmentPrediction:
    """Lane segments predicted by Q queries (OpenLane-V2 `lane_segment`, LaneSegNet).

    Attributes:
        points: (Q, P, 3) centerline, metres, ego frame, in driving direction.
        left, right: (Q, P, 3) boundaries in driving direction, metres.
        logits: (Q, C) class logits (sigmoid): lane segment, then pedestrian crossing, unless `areas` has these.
        left_type_logits, right_type_logits: (Q, T) by `LineType`; None where types are not predicted.
        mask_logits: (Q, H, W) lane area on the BEV grid, row 0 at the smallest y; None without a mask head.
        successor_logits: (Q, Q) [i, j]: segment j continues segment i; None for a model without topology.
        areas: crossings and road boundaries of queries of their own; None where crossings are segments.
    """

    points: Float[Array, "*layers q p 3"]
    left: Float[Array, "*layers q p 3"]
    right: Float[Array, "*layers q p 3"]
    logits: Float[Array, "*layers q c"]
    left_type_logits: Float[Array, "*layers q t"] | None = None
    right_type_logits: Float[Array, "*layers q t"] | None = None
    mask_logits: Float[Array, "*layers q h w"] | None = None
    successor_logits: Float[Array, "*layers q q"] | None = None
    areas: AreaPrediction | None = None

    @property
    def scores(self) -> Float[Array, "*layers q"]:
        """Confidence of the best class, 0 to 1."""
        return best_confidence(self.logits)


@struct.dataclass
class LinePrediction:
    """Map lines of a vector map predicted by Q queries (MapTR).

    Attributes:
        points: (Q, P, D) metres, ego frame; D = 2 or 3.
        logits: (Q, C) class logits (sigmoid), by `LineClass`.
    """

    points: Float[Array, "*layers q p d"]
    logits: Float[Array, "*layers q c"]

    @property
    def scores(self) -> Float[Array, "*layers q"]:
        """Confidence of the best class, 0 to 1."""
        return best_confidence(self.logits)


@struct.dataclass
class ElementPrediction:
    """Traffic lights and signs predicted by E queries in the front image.

    Attributes:
        box: (E, 2, 2) top-left and bottom-right corners, pixels of camera 0.
        logits: (E, 13) by OpenLane-V2 attribute (sigmoid).
        lane_logits: (Q, E) [i, e]: element e governs lane i of the same prediction; None without topology.
    """

    box: Float[Array, "*layers e 2 2"]
    logits: Float[Array, "*layers e a"]
    lane_logits: Float[Array, "*layers q e"] | None = None

    @property
    def scores(self) -> Float[Array, "*layers e"]:
        """Confidence of the best attribute, 0 to 1."""
        return best_confidence(self.logits)


@struct.dataclass
class CurvePrediction:
    """Lane lines of one image, predicted by Q queries as lane shape parameters (GTN paper, Eq. 7 and 8).

    Attributes:
        logits: (Q, 2) class logits (softmax), index 1 is a lane.
        curves: (Q, 8) rows v of the upper and the lower end (alpha, beta; LSTR calls these numbers lower and upper),
            k'', f'', m'', n', b'', b''' in fractions of the image.
    """

    logits: Float[Array, "*layers q 2"]
    curves: Float[Array, "*layers q 8"]

    @property
    def scores(self) -> Float[Array, "*layers q"]:
        """Probability that the query is a lane, 0 to 1."""
        return jax.nn.softmax(self.logits)[..., 1]


LanePrediction = CenterlinePrediction | SegmentPrediction | LinePrediction
"""Lanes around the vehicle, or lines of a vector map."""


@struct.dataclass
class Prediction:
    """All predictions for one frame; no model predicts all parts.

    Attributes:
        centerlines: merged centerlines and their topology.
        segments: lane segments and their topology.
        lines: lines of a vector map.
        elements: traffic lights and signs.
        curves: lane shapes in one image.
    """

    centerlines: CenterlinePrediction | None = None
    segments: SegmentPrediction | None = None
    lines: LinePrediction | None = None
    elements: ElementPrediction | None = None
    curves: CurvePrediction | None = None

    @property
    def lanes(self) -> LanePrediction:
        """The predicted segments, centerlines or lines of a vector map; raises UserError where the model has none."""
        for found in (self.segments, self.centerlines, self.lines):
            if found is not None:
                return found
        raise UserError("this model predicts no lanes around the vehicle: choose a run of another model")
