"""Topology from the geometry of predicted lanes, added to the learned one at evaluation; nothing is trained.

After TopoLogic (Fu et al., NeurIPS 2024): where a predicted lane ends near the start of another one, the second
follows the first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.special import expit, logit

from tflane_jax.scene import Prediction

SCALE = 11.5275
"""TopoLogic's scale of squared distances, square metres."""
_MOST = 1.0 - 1e-7


def geometric_edges(points: Float[np.ndarray, "q p 3"]) -> Float[np.ndarray, "q q"]:
    """Return exp(-d^2 / `SCALE`), d the L1 distance from the end of lane i to the start of lane j in metres.

    As in TopoLogic, it is 0 for a lane and itself.
    """
    ends, starts = np.asarray(points)[:, -1], np.asarray(points)[:, 0]
    distance = np.abs(ends[:, None] - starts[None]).sum(-1)
    return np.exp(-(distance**2) / SCALE) * ~np.eye(len(ends), dtype=bool)


def with_geometric_topology(prediction: Prediction) -> Prediction:
    """Return the prediction of one example, last layer, whose edges have the sum of both scores, as a confidence.

    TopoLogic evaluates the sum s itself, which is up to 2. Metrics take confidences up to 1 and read their order and
    whether they are above 0.5: s above 0.5 becomes 0.5 + (s - 0.5) / 3, which keeps both.

    Lanes without predicted topology, and vector maps, stay as they are.
    """
    changed = {
        name: replace(part, successor_logits=_added(part.points, part.successor_logits))
        for name in ("centerlines", "segments")
        if (part := getattr(prediction, name)) is not None and part.successor_logits is not None
    }
    return replace(prediction, **changed)


def _added(points: Float[np.ndarray, "q p 3"], logits: Float[np.ndarray, "q q"]) -> Float[np.ndarray, "q q"]:
    both = expit(np.asarray(logits, np.float64)) + geometric_edges(points)
    return logit(np.minimum(np.where(both <= 0.5, both, 0.5 + (both - 0.5) / 3.0), _MOST))
