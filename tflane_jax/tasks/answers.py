"""A prediction as arrays by name and as plain values: what commands write, and what an exported program returns."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

from tflane_jax.scene import LinePrediction, Prediction, SegmentPrediction

# Arrays of a lane that only models of segments, or of a vector map, have.
_OF_KIND = ("left", "right", "category", "left_type", "right_type")


def answer_arrays(prediction: Prediction) -> dict[str, Any]:
    """Return the arrays of predictions.npz (docs/predictions.md) that a model predicts; numpy of numpy, else JAX's.

    Arrays may have leading axes. `successor` holds the learned scores, zeros for a model without topology.
    """
    lanes, elements = prediction.lanes, prediction.elements
    on_host = isinstance(lanes.logits, np.ndarray)
    sigmoid: Any = expit if on_host else jax.nn.sigmoid
    arrays: dict[str, Any] = {"points": lanes.points, "scores": sigmoid(lanes.logits).max(-1)}
    if isinstance(lanes, LinePrediction):
        arrays["category"] = lanes.logits.argmax(-1)
    else:
        shape, zeros = lanes.logits.shape[:-1], np.zeros if on_host else jnp.zeros
        logits = lanes.successor_logits
        arrays["successor"] = zeros((*shape, shape[-1])) if logits is None else sigmoid(logits)
    if isinstance(lanes, SegmentPrediction):
        arrays |= {"left": lanes.left, "right": lanes.right, "category": lanes.logits.argmax(-1)}
        types = {"left_type": lanes.left_type_logits, "right_type": lanes.right_type_logits}
        arrays |= {name: logits.argmax(-1) for name, logits in types.items() if logits is not None}
    if elements is not None:
        arrays |= {"box": elements.box, "attribute_score": sigmoid(elements.logits)}
        if elements.lane_logits is not None:
            arrays["element_lane"] = sigmoid(elements.lane_logits)
    return arrays


def best_first(scores: Float[np.ndarray, " q"], threshold: float) -> Int[np.ndarray, " k"]:
    """Return the numbers of the queries with a score of at least `threshold`, best first."""
    order = np.argsort(-scores, kind="stable")
    return order[scores[order] >= threshold]


def lane_records(arrays: dict[str, np.ndarray], queries: Int[np.ndarray, " k"]) -> list[dict[str, Any]]:
    """Return lanes of one frame (`arrays` without leading axes) as the "lanes" of predictions.json."""
    kinds = [name for name in _OF_KIND if name in arrays]
    return [
        {"query": q, "score": float(arrays["scores"][q]), "points": arrays["points"][q].tolist()}
        | {name: arrays[name][q].tolist() for name in kinds}
        for q in queries.tolist()
    ]
