"""Truth and detections of one frame: lanes, their topology and traffic elements.

Plain numpy arrays and ragged lists, so that predictions of any framework fit in. `tflane_jax.evaluation` makes them
from the containers of `tflane_jax.scene`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry.polylines import pad_lines

# By which a confidence may miss 0 to 1, such as the sum of a softmax.
_ROUNDING = 1e-6
T = TypeVar("T")
Lines = Sequence[Float[np.ndarray, "_ d"]] | Float[np.ndarray, "l n d"]


@dataclass(frozen=True)
class ElementTruth:
    """Traffic elements of one frame and the lanes that they govern.

    Attributes:
        boxes: (T, 2, 2) top-left and bottom-right corner, pixels.
        attributes: (T,) OpenLane-V2 attribute 0 to 12.
        lane: (G, T) element t governs lane g.
    """

    boxes: Float[np.ndarray, "t 2 2"]
    attributes: Int[np.ndarray, " t"]
    lane: Bool[np.ndarray, "g t"]


@dataclass(frozen=True)
class ElementDetections:
    """Detected traffic elements of one frame.

    Attributes:
        boxes: (U, 2, 2) top-left and bottom-right corner, pixels.
        attributes: (U,) OpenLane-V2 attribute 0 to 12.
        scores: (U,) confidence, 0 to 1.
        lane: (P, U) confidence that element u governs detected lane p, 0 to 1.
    """

    boxes: Float[np.ndarray, "u 2 2"]
    attributes: Int[np.ndarray, " u"]
    scores: Float[np.ndarray, " u"]
    lane: Float[np.ndarray, "p u"]


@dataclass(frozen=True)
class LaneTruth:
    """Ground truth of one frame: G lanes.

    Attributes:
        points: G polylines (n, 3) in driving direction, metres, ego frame; each may have its own n >= 1.
        successor: (G, G) [i, j] lane j continues lane i.
        visibility: (G,) fraction of the lane in direct line of sight, 0 to 1; None where it is not known.
        elements: traffic elements; None where the task has none.
    """

    points: Lines
    successor: Bool[np.ndarray, "g g"]
    visibility: Float[np.ndarray, " g"] | None = None
    elements: ElementTruth | None = None


@dataclass(frozen=True)
class LaneDetections:
    """Detections of one frame: P lanes, in any order.

    Attributes:
        points: P polylines (n, 3) in driving direction, metres, ego frame; each may have its own n >= 1.
        scores: (P,) confidence, 0 to 1.
        successor: (P, P) [i, j] confidence that lane j continues lane i, 0 to 1.
        elements: traffic elements; None where the model predicts none.
    """

    points: Lines
    scores: Float[np.ndarray, " p"]
    successor: Float[np.ndarray, "p p"]
    elements: ElementDetections | None = None


def checked_lines(lines: Lines, what: str, dims: int = 3) -> Float[np.ndarray, "l n d"]:
    """Return the polylines of one frame as one array; raise UserError for lines without points or not finite."""
    try:
        points = pad_lines(lines, dims)
    except ValueError as error:
        raise UserError(f"{what}: {error}") from None
    if points.ndim != 3 or points.shape[-1] != dims:
        expected = f"expected lines of {dims}-D points (lines, points, {dims})"
        raise UserError(f"{what}: points have shape {points.shape}, {expected}")
    finite = np.isfinite(points)
    if not finite.all():
        finite = finite.all((1, 2))
        raise UserError(f"{what}: line {int(finite.argmin())} has a coordinate that is not finite")
    return points


def check_kinds(detections: Any, truth: Any, kinds: tuple[type, type]) -> None:
    """Raise UserError for arguments of an `update` that are swapped; `kinds` are those of detections and truth."""
    found, true = kinds
    if isinstance(detections, true) or isinstance(truth, found):
        given = f"{type(detections).__name__} and {type(truth).__name__}"
        raise UserError(f"{given} are given: detections ({found.__name__}) come first, then truth ({true.__name__})")


def one_of(name: str, value: T, allowed: Any) -> T:
    """Return an argument that is a `Literal`; raise UserError, with what is allowed, for any other value."""
    if value not in get_args(allowed):
        raise UserError(f"{name} is {value!r}: it must be {' or '.join(map(repr, get_args(allowed)))}")
    return value


def check_shape(array: np.ndarray, shape: tuple[int, ...], what: str) -> None:
    """Raise UserError if the array has another shape or holds a number that is not finite."""
    if array.shape != shape:
        raise UserError(f"{what} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise UserError(f"{what} holds a number that is not finite")


def checked_edges(edges: Any, shape: tuple[int, ...], what: str) -> Bool[np.ndarray, "a b"]:
    """Return true relations as flags; raise UserError for another shape or a number that is neither 0 nor 1."""
    edges = np.asarray(edges)
    check_shape(edges, shape, what)
    if edges.dtype != bool and ((edges != 0) & (edges != 1)).any():
        raise UserError(f"{what} holds a number that is neither 0 nor 1")
    return edges.astype(bool)


def checked_confidence(confidence: Any, shape: tuple[int, ...], what: str) -> Float[np.ndarray, "a b"]:
    """Return confidences of relations; raise UserError for another shape or negative numbers, such as logits.

    They may exceed 1, as sums do: their order counts, which exceed 0.5, and in OpenLane-V2's v1.0 which exceed 1.
    """
    confidence = np.asarray(confidence)
    check_shape(confidence, shape, what)
    if (confidence < -_ROUNDING).any():
        raise UserError(f"{what} has negative confidences: apply the sigmoid to logits first")
    return confidence


def checked_numbers(numbers: Any, count: int, limits: tuple[int, int], what: str) -> Int[np.ndarray, " n"]:
    """Return the numbers of classes as integers of an array of their own.

    Raises UserError for another shape, numbers that are not whole, or outside the limits (both included).
    """
    numbers = np.asarray(numbers)
    check_shape(numbers, (count,), what)
    whole = numbers.astype(np.int64)
    low, high = limits
    if (whole != numbers).any() or ((whole < low) | (whole > high)).any():
        raise UserError(f"{what} must be whole numbers from {low} to {high}")
    return whole
