"""Topology from the geometry of predicted lanes, added to the learned one at evaluation; nothing is trained.

After TopoLogic (Fu et al., NeurIPS 2024): where a predicted lane ends near the start of another one, the second
follows the first.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.special import expit

Topology = Literal["learned", "geometric"]
"""Edges between lanes at evaluation: as predicted, or with TopoLogic's geometric score added."""

SCALE = 11.5275
"""TopoLogic's scale of squared distances, square metres."""


def edge_confidences(
    points: Float[np.ndarray, "q p 3"], logits: Float[np.ndarray, "q q"] | None, topology: Topology = "learned"
) -> Float[np.ndarray, "q q"]:
    """Return the confidences of the edges of one example; zeros for a model that predicts no topology.

    With geometry they are the sums that TopoLogic evaluates, up to 2. In OpenLane-V2's v1.0 an edge above 1 ranks
    before those that the program assumes.
    """
    if logits is None:
        return np.zeros((len(points),) * 2)
    learned = expit(np.asarray(logits))
    return learned if topology == "learned" else learned.astype(np.float64) + geometric_edges(points)


def geometric_edges(points: Float[np.ndarray, "q p 3"]) -> Float[np.ndarray, "q q"]:
    """Return exp(-d^2 / `SCALE`), d the L1 distance from the end of lane i to the start of lane j in metres.

    As in TopoLogic, it is 0 for a lane and itself.
    """
    ends, starts = np.asarray(points)[:, -1], np.asarray(points)[:, 0]
    distance = np.abs(ends[:, None] - starts[None]).sum(-1)
    return np.exp(-(distance**2) / SCALE) * ~np.eye(len(ends), dtype=bool)
