"""Of which scores lower is better."""

from __future__ import annotations

from collections.abc import Collection

ERRORS = ("AE_type", "AE_dist", "FP", "FN", "loss")
"""Names of such scores without their group: LaneSegNet's errors of types and distances, TuSimple's rates, the loss."""


def lower_is_better(score: str, errors: Collection[str] = ERRORS) -> bool:
    """Return whether a score ("group/name", also at a threshold, "group/name@0.5") is one of the errors."""
    return score.rpartition("/")[2].partition("@")[0] in errors
