"""Topology scores of OpenLane-V2: the average precision of each true vertex, in the two published versions.

Source: shared specs/metrics.md sections 2.4 (v2.1 = v1.1) and 2.6 (v1.0).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.metrics.matching import descending, vertex_average_precision

Version = Literal["v2.1", "v1.0"]

# The confidence of a false edge that the official program puts where no matched pair says anything: just above the
# edge threshold 0.5 (by float32's epsilon) in v2.1, the highest in v1.0.
FILL: dict[Version, float] = {"v2.1": 0.5 + 2.0**-23, "v1.0": 1.0}
LEVELS = 10


def matchings(
    scores: Float[np.ndarray, " p"], taken: Int[np.ndarray, " p"], version: Version
) -> Int[np.ndarray, "levels p"]:
    """Return the matchings over which the version averages: the one given in v2.1, ten cut-off ones in v1.0."""
    if version == "v2.1":
        return taken[None]
    return np.where(confidence_levels(scores, taken), taken, -1)


def confidence_levels(scores: Float[np.ndarray, " p"], taken: Int[np.ndarray, " p"]) -> Bool[np.ndarray, "levels p"]:
    """Return which matches take part at each of the ten confidence cut-offs of the v1.0 topology score."""
    n = len(scores)
    if n == 0:
        return np.zeros((LEVELS, 0), bool)
    order = descending(scores)
    found = np.cumsum(taken[order] >= 0)
    # The next rank above, except that an even rank stays.
    rank = n * np.arange(1, LEVELS + 1) / LEVELS - 1.5
    low = np.floor(rank)
    k = np.where((rank == low) & (low % 2 == 0), low, low + 1).astype(int).clip(0)
    last = np.searchsorted(found, found[k], side="right") - 1
    return (taken >= 0) & (scores >= scores[order][last][:, None])


def topology_precision(
    edges: Bool[np.ndarray, "g t"],
    confidence: Float[np.ndarray, "p u"],
    rows: Int[np.ndarray, "k p"],
    columns: Int[np.ndarray, "k u"],
    fill: float,
) -> Float[np.ndarray, "k g+t"]:
    """Return the average precision of every true vertex (g rows, then t columns) for k matchings.

    `rows` and `columns` give the truth that each detection takes, -1 for none. The confidence of a detected edge
    counts where both its ends are matched. Everywhere else stand no edge where there is one, and a false edge of
    confidence `fill` where there is none.
    """
    matched = np.broadcast_to(np.where(edges, 0.0, fill), (len(rows), *edges.shape))
    if confidence.size:
        row, column = _inverse(rows, edges.shape[0])[:, :, None], _inverse(columns, edges.shape[1])[:, None]
        matched = np.where((row >= 0) & (column >= 0), confidence[row, column], matched)
    outgoing = vertex_average_precision(edges, matched)
    incoming = vertex_average_precision(edges.T, np.swapaxes(matched, -1, -2))
    return np.concatenate([outgoing, incoming], -1)


def _inverse(taken: Int[np.ndarray, "k p"], truths: int) -> Int[np.ndarray, "k g"]:
    """Return for each truth the detection that takes it, -1 for none."""
    taker = np.full((len(taken), truths), -1)
    matching, detection = np.nonzero(taken >= 0)
    taker[matching, taken[matching, detection]] = detection
    return taker
