"""Common data containers: examples, ground truth, priors and predictions of one frame, as fixed-size arrays.

One `Example` holds one frame of one scene in the **ego frame** (x forward, y left, z up; metres, radians).
Containers are pytrees without a batch axis; callers `vmap`. Every padded array has a bool `valid` beside it. Padding
is arbitrary (NaN included) and must never affect an output.
Arrays are numpy on the host and jax on the device; dtype float32, bool and int32 unless a docstring says otherwise.

Host-side recordings in global coordinates (maps, poses, tracks) are in `tflane_jax.scene.logs`.
"""

from tflane_jax.scene.example import (
    Example,
    RoadImage,
    row_of,
    shapes_of,
    stack_examples,
)
from tflane_jax.scene.prediction import (
    AreaPrediction,
    CenterlinePrediction,
    CurvePrediction,
    ElementPrediction,
    LanePrediction,
    LinePrediction,
    Prediction,
    SegmentPrediction,
)
from tflane_jax.scene.priors import (
    MarkerObservations,
    RoadUser,
    SdCategory,
    SdMap,
    TrafficFlow,
)
from tflane_jax.scene.truth import (
    Areas,
    AreaType,
    LaneGraph,
    LaneLines,
    LineClass,
    LineType,
    MapLines,
    TrafficElements,
)
from tflane_jax.scene.views import (
    BevChannel,
    CameraViews,
    VehicleState,
)

__all__ = [
    "AreaPrediction",
    "AreaType",
    "Areas",
    "BevChannel",
    "CameraViews",
    "CenterlinePrediction",
    "CurvePrediction",
    "ElementPrediction",
    "Example",
    "LaneGraph",
    "LaneLines",
    "LanePrediction",
    "LineClass",
    "LinePrediction",
    "LineType",
    "MapLines",
    "MarkerObservations",
    "Prediction",
    "RoadImage",
    "RoadUser",
    "SdCategory",
    "SdMap",
    "SegmentPrediction",
    "TrafficElements",
    "TrafficFlow",
    "VehicleState",
    "row_of",
    "shapes_of",
    "stack_examples",
]
