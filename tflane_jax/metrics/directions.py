"""Of which scores lower is better, and in which unit people read them."""

from __future__ import annotations

from collections.abc import Collection

ERRORS = ("AE_type", "AE_dist", "FP", "FN", "loss")
"""Names of such scores without their group: LaneSegNet's errors of types and distances, TuSimple's rates, the loss."""


METRES = ("AE_dist",)
"""Names of scores that are distances; all others are fractions."""


def unit_of(score: str) -> tuple[float, str]:
    """Return by what a score ("group/name", also at a threshold) is multiplied to be shown, and the unit of that."""
    return (1.0, "m") if score.rpartition("/")[2].partition("@")[0] in METRES else (100.0, "percent")


def lower_is_better(score: str, errors: Collection[str] = ERRORS) -> bool:
    """Return whether a score ("group/name", also at a threshold, "group/name@0.5") is one of the errors."""
    return score.rpartition("/")[2].partition("@")[0] in errors
