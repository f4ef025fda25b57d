"""Official lane metrics, re-implemented, with the version of the protocol in their name."""

from tflane_jax.files.tusimple import RowLanes
from tflane_jax.metrics.consistency import MapConsistency
from tflane_jax.metrics.f_score import CenterlineFScore
from tflane_jax.metrics.frames import (
    ElementDetections,
    ElementTruth,
    LaneDetections,
    LaneTruth,
)
from tflane_jax.metrics.groups import GroupedMetrics
from tflane_jax.metrics.lane_segment import LaneSegmentMetrics
from tflane_jax.metrics.map_matching import MapDetections, MapTruth
from tflane_jax.metrics.openlane_v2 import CenterlineMetrics
from tflane_jax.metrics.segment_matching import (
    AreaDetections,
    AreaTruth,
    SegmentDetections,
    SegmentTruth,
)
from tflane_jax.metrics.tusimple import TuSimpleMetrics
from tflane_jax.metrics.vector_map import VectorMapMetrics

__all__ = [
    "AreaDetections",
    "AreaTruth",
    "CenterlineFScore",
    "CenterlineMetrics",
    "ElementDetections",
    "ElementTruth",
    "GroupedMetrics",
    "LaneDetections",
    "LaneSegmentMetrics",
    "LaneTruth",
    "MapConsistency",
    "MapDetections",
    "MapTruth",
    "RowLanes",
    "SegmentDetections",
    "SegmentTruth",
    "TuSimpleMetrics",
    "VectorMapMetrics",
]
