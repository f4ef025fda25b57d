"""Losses of traffic elements in the front view: Deformable DETR's, as TopoNet uses them (docs/reference/toponet.md).

Per decoder layer: focal loss on the class, L1 on center and size as fractions of the image, and generalised IoU.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.limits import Fraction, PositiveOrZero
from tflane_jax.losses.common import Terms, focal, positives
from tflane_jax.losses.costs import focal_cost, generalised_iou, pairwise_l1
from tflane_jax.matching import Assignment, match
from tflane_jax.scene import ElementPrediction, Example, TrafficElements


@dataclass(frozen=True)
class ElementLossConfig:
    """Weights of both matching costs and loss terms; the defaults are TopoNet's.

    Attributes:
        class_weight, box_weight, iou_weight: weights of class, L1 and generalised IoU.
        alpha, gamma: parameters of the focal terms.
        empty_frames: frames without elements. "keep": their queries are negatives of the class loss; "skip": they have
            no loss, and losses are divided by the number of frames where that is larger than that of matched elements,
            as in the published training, where every device has one frame.
    """

    class_weight: PositiveOrZero = 1.0
    box_weight: PositiveOrZero = 2.5
    iou_weight: PositiveOrZero = 1.0
    alpha: Fraction = 0.25
    gamma: PositiveOrZero = 2.0
    empty_frames: Literal["keep", "skip"] = "keep"


def clear_padding(elements: TrafficElements) -> TrafficElements:
    """Return the elements with zeros in padding, so that 0 * padding is 0 (any leading axes)."""
    box = jnp.where(elements.valid[..., None, None], elements.box, 0.0)
    attribute = jnp.where(elements.valid, elements.attribute, 0)
    return elements.replace(box=box, attribute=attribute)  # pyright: ignore[reportAttributeAccessIssue]


def element_cost(
    prediction: ElementPrediction, elements: TrafficElements, size: Int[Array, " 2"], config: ElementLossConfig
) -> Float[Array, "layers e n"]:
    """Return the cost of matching each element with each query, for one example; columns of padding are arbitrary.

    Args:
        prediction: outputs of every decoder layer.
        elements: ground truth.
        size: width and height of the front image, pixels.
        config: weights.
    """
    logits = jnp.take(prediction.logits, elements.attribute, -1, mode="clip")  # (D, E, N)
    cost_class = focal_cost(logits, config.alpha, config.gamma)
    cost_box = pairwise_l1(_fractions(prediction.box, size), _fractions(elements.box, size)[None])
    iou = generalised_iou(prediction.box[:, :, None], elements.box[None, None])
    return config.class_weight * cost_class + config.box_weight * cost_box - config.iou_weight * iou


def true_elements(batch: Example) -> tuple[TrafficElements, Int[Array, "b 2"]]:
    """Return the traffic elements of a batch, and width and height of the front images, pixels.

    Raises UserError if the data have none.
    """
    if batch.traffic_elements is None or batch.cameras is None:
        raise UserError(
            "the model predicts traffic elements, and these data label none: choose data with front images and "
            "traffic elements, or set task.model.elements to None"
        )
    return batch.traffic_elements, batch.cameras.size[:, 0]


def assign_elements(
    prediction: ElementPrediction,
    elements: TrafficElements,
    size: Int[Array, "b 2"],
    weights: ElementLossConfig,
    matcher: Literal["scipy", "jax"],
) -> Assignment:
    """Return the assignment (B, D, E) of a batch; `elements` without garbage in padding (`clear_padding`)."""
    cost = jax.vmap(partial(element_cost, config=weights))(prediction, elements, size)
    return match(cost, elements.valid[:, None], matcher)


def element_losses(
    prediction: ElementPrediction,
    assignment: Assignment,
    elements: TrafficElements,
    size: Int[Array, "b 2"],
    weights: ElementLossConfig,
) -> Terms:
    """Return the weighted losses `element_class`, `element_box` and `element_iou` of every layer of a batch."""
    # The topology may have fewer layers than the other leaves.
    prediction = prediction.replace(lane_logits=None)  # pyright: ignore[reportAttributeAccessIssue]
    each = jax.vmap(partial(element_terms, config=weights), in_axes=(0, 0, None, None))
    classes, boxes, apart = jax.vmap(each)(prediction, assignment, elements, size)  # each (B, D)
    count = positives(assignment)
    if weights.empty_frames == "skip":
        classes = jnp.where(elements.valid.any(-1)[:, None], classes, 0.0)  # the other two are 0 there
        # The published count is a mean over devices of one frame, those without elements among them, and at least 1.
        count = jnp.maximum(count, float(elements.valid.shape[0]))
    return {
        "element_class": weights.class_weight * classes.sum(0) / count,
        "element_box": weights.box_weight * boxes.sum(0) / count,
        "element_iou": weights.iou_weight * apart.sum(0) / count,
    }


def element_terms(
    prediction: ElementPrediction,
    assignment: Assignment,
    elements: TrafficElements,
    size: Int[Array, " 2"],
    config: ElementLossConfig,
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return the unweighted sums of class, L1 and generalised-IoU losses of one layer of one example."""
    queries = prediction.logits.shape[0]
    # Index `queries` lies outside, so unmatched targets write nowhere.
    query = jnp.where(assignment.matched, assignment.query, queries)
    label = jnp.zeros(prediction.logits.shape).at[query, elements.attribute].set(1.0, mode="drop")
    class_loss = focal(prediction.logits, label, config.alpha, config.gamma).sum()

    chosen = prediction.box[assignment.query]  # (N, 2, 2)
    error = jnp.abs(_fractions(chosen, size) - _fractions(elements.box, size)).sum(-1)
    apart = 1.0 - generalised_iou(chosen, elements.box)
    total = lambda x: jnp.where(assignment.matched, x, 0.0).sum()  # noqa: E731
    return class_loss, total(error), total(apart)


def _fractions(box: Float[Array, "*b 2 2"], size: Int[Array, " 2"]) -> Float[Array, "*b 4"]:
    """Return center and size of boxes as fractions of the image."""
    unit = jnp.maximum(size.astype(box.dtype), 1.0).reshape((1,) * (box.ndim - 2) + (2,))
    low, high = box[..., 0, :], box[..., 1, :]
    return jnp.concatenate([0.5 * (low + high) / unit, (high - low) / unit], -1)
