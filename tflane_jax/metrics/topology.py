"""Topology scores of OpenLane-V2: the average precision of each true vertex, in the two published versions.

Source: `topology` in openlanev2/centerline/evaluation of the OpenLane-V2 devkit, tags v1.0.0 and v2.1.0.
docs/reference/metrics.md describes both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.metrics.matching import descending, vertex_average_precision

Version = Literal["v2.1", "v1.0"]

# The confidence of the false edge that the official program assumes at a vertex without a match: just above the edge
# threshold 0.5 (by float32's epsilon) in v2.1, the highest possible in v1.0.
FILL: dict[Version, float] = {"v2.1": 0.5 + 2.0**-23, "v1.0": 1.0}
LEVELS = 10


def check_versions(versions: Sequence[Version]) -> tuple[Version, ...]:
    """Return the versions as a tuple; raise UserError if there is none, an unknown one, or one of them twice."""
    known = get_args(Version)
    if (
        isinstance(versions, str)
        or not versions
        or len(set(versions)) != len(versions)
        or not set(versions) <= set(known)
    ):
        wanted = f"a tuple of some of {known}, each once, such as ({known[0]!r},)"
        raise UserError(f"versions of the topology score are {versions!r}, expected {wanted}")
    return tuple(versions)


def matchings(
    scores: Float[np.ndarray, " p"], taken: Int[np.ndarray, " p"], version: Version
) -> Int[np.ndarray, "levels p"]:
    """Return the matchings over which the version averages: v2.1 the given one, v1.0 ten that are cut by confidence.

    `taken` is the true lane or element of each detection, -1 for none.
    """
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

    A pair of true vertices that are both matched gets the confidence of the detected edge. Every other pair counts as
    wrong: a true edge is missed (confidence 0), and where there is no edge a false one has the confidence `fill`.

    Args:
        edges: true edges.
        confidence: of the detected edges, 0 to 1.
        rows, columns: the true vertex that each detection takes, -1 for none; one row for each matching.
        fill: confidence of false edges.
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
