"""Official lane metrics, re-implemented, with the version of the protocol in their name."""

from tflane_jax.metrics.frames import (
    ElementDetections,
    ElementTruth,
    LaneDetections,
    LaneTruth,
    detections_from_prediction,
    truth_from_example,
)
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics, GroupedCenterlineMetrics

__all__ = [
    "CenterlineMetrics",
    "ElementDetections",
    "ElementTruth",
    "GroupedCenterlineMetrics",
    "LaneDetections",
    "LaneTruth",
    "detections_from_prediction",
    "truth_from_example",
]
