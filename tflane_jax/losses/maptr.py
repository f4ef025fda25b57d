"""MapTR's loss of map lines, with deep supervision (Liao et al. 2023).

Per decoder layer: focal loss on the classes, L1 on the points in fractions of the range, and the cosine between true
and predicted steps from point to point. A true line stands for all of its equivalent orders: the matching cost takes
the nearest one, before the assignment, and the loss of a matched line takes it too. Weights: docs/reference/maptr.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.line_orders import Ways, point_orders
from tflane_jax.limits import Divisor, Fraction, PositiveOrZero
from tflane_jax.losses.auxiliary import denoising_pairs
from tflane_jax.losses.common import (
    HostLossConfig,
    Report,
    Terms,
    class_losses,
    declared_outputs,
    last_layer,
    matched,
    positives,
    total,
    without_loss,
)
from tflane_jax.losses.costs import focal_cost, pairwise_l1
from tflane_jax.matching import Assignment, match
from tflane_jax.models.auxiliary import AuxiliaryOutputs
from tflane_jax.scene import Example, LineClass, LinePrediction, MapLines, Prediction


@dataclass(frozen=True)
class MapTrLossConfig(HostLossConfig):
    """Weights of matching costs and loss terms; the defaults are MapTR's.

    Attributes:
        class_weight, points_weight: weights of both cost and loss; points in fractions of the range, summed over
            coordinates.
        direction_weight: weight of the steps' directions.
        least_step: length below which steps count less for the direction, metres. The gradient of a direction grows as
            1 / length of the predicted step. The default is PyTorch's epsilon, with which a single pair of coinciding
            points, as lines have them in a corner of the range, can exceed all other gradients.
        alpha, gamma: parameters of every focal term.
        rings: directions in which a true ring may be matched, see `geometry.line_orders`: "one" as MapTR does, "both"
            for truth whose rings turn either way.
        matcher: backend of `matching.match`.
        class_target: of a query matched with a line: "one", or "quality" (`line_quality`).
    """

    class_weight: PositiveOrZero = 2.0
    points_weight: PositiveOrZero = 5.0
    direction_weight: PositiveOrZero = 0.005
    least_step: Divisor = 1e-6
    alpha: Fraction = 0.25
    gamma: PositiveOrZero = 2.0
    rings: Ways = "one"
    matcher: Literal["scipy", "jax"] = "jax"
    class_target: Literal["one", "quality"] = "one"

    def loss(
        self, outputs: Prediction, auxiliary: AuxiliaryOutputs, batch: Example, host: Any
    ) -> tuple[Float[Array, ""], Report]:
        """Return the loss of a batch and the numbers to record, see `HostLossConfig.loss`."""
        if outputs.lines is None:
            raise ValueError("MapTR's loss needs predicted map lines")
        if batch.map_lines is None:
            raise UserError(
                "the model learns the lines of a vector map, and these data have none (map_lines is None): set "
                "data.example.map_lines"
            )
        lines, range_ = batch.map_lines, host.bev_range
        coordinates, classes = outputs.lines.points.shape[-1], outputs.lines.logits.shape[-1]
        targets = jax.vmap(partial(line_targets, coordinates=coordinates, classes=classes, rings=self.rings))(lines)
        loss, report = line_loss(outputs.lines, targets, range_, self)
        for name, output in declared_outputs(auxiliary, host.auxiliary):
            terms = self.auxiliary_terms(name, output, targets, batch, host)
            loss, report = loss + total(terms), report | last_layer(terms)
        return loss, report

    def auxiliary_terms(self, name: str, output: Any, targets: LineTargets, batch: Example, host: Any) -> Terms:
        """Return the weighted losses of an auxiliary output.

        Args:
            name, output: of `AuxiliaryOutputs`, leading axis batch.
            targets: true lines with equivalent orders, leading axis batch.
            batch: the examples.
            host: the host's configuration.

        Raises:
            ValueError: the output has no loss here.
        """
        if name != "denoised":
            raise without_loss(name, "auxiliary_terms")
        terms = line_denoising_losses(output, targets, host.bev_range, self)
        return {f"denoised_{key}": value for key, value in terms.items()}


@struct.dataclass
class LineTargets:
    """True lines with their equivalent orders; padding is zero.

    Attributes:
        orders: (L, O, P, D) metres.
        order_valid: (L, O) the order exists.
        category: (L,) `LineClass`.
        valid: (L,).
    """

    orders: Float[Array, "*b l o p d"]
    order_valid: Bool[Array, "*b l o"]
    category: Int[Array, "*b l"]
    valid: Bool[Array, "*b l"]


def line_targets(lines: MapLines, coordinates: int, classes: int, rings: Ways = "one") -> LineTargets:
    """Return the targets of one example.

    Args:
        lines: ground truth; padding may hold anything. Lines of a class that the model does not have are left out.
        coordinates: D.
        classes: of the model, the first ones of `LineClass`.
        rings: directions of a ring.
    """
    category, valid = jnp.asarray(lines.category), lines.of_classes(classes).valid
    points = jnp.where(valid[:, None, None], jnp.asarray(lines.points)[..., :coordinates], 0.0)
    directed = category == LineClass.CENTERLINE
    orders, order_valid = point_orders(points, jnp.asarray(lines.closed), directed, rings)
    return LineTargets(orders, order_valid, jnp.where(valid, category, 0), valid)


def line_loss(
    prediction: LinePrediction, targets: LineTargets, range_: PerceptionRange, config: MapTrLossConfig
) -> tuple[Float[Array, ""], Report]:
    """Return the loss of a batch and its terms.

    Args:
        prediction: outputs of every decoder layer, leading axes (batch, layer).
        targets: ground truth, leading axis batch.
        range_: the box that normalised coordinates span, metres.
        config: weights.

    Returns:
        The sum over layers of all weighted terms, and the terms of the last layer under `class`, `points` and
        `direction`; and `matching/lines`, the mean number of matched lines per example.
    """
    assignment = assign_lines(prediction, targets, range_, config)
    terms = line_losses(prediction, assignment, targets, range_, config)
    return total(terms), last_layer(terms) | {"matching/lines": matched(assignment)}


def assign_lines(
    prediction: LinePrediction,
    targets: LineTargets,
    range_: PerceptionRange,
    config: MapTrLossConfig,
    repeats: int = 1,
) -> Assignment:
    """Return the assignment (B, D, L) of a batch; with every target `repeats` times, one copy of all after the other.

    Repeated targets need no costs of their own.
    """
    each = jax.vmap(partial(matching_cost, range_=range_, config=config), in_axes=(0, None))
    cost = jnp.concatenate([jax.vmap(each)(prediction, targets)] * repeats, -1)
    return match(cost, jnp.concatenate([targets.valid] * repeats, -1)[:, None], config.matcher)


def matching_cost(
    prediction: LinePrediction, targets: LineTargets, range_: PerceptionRange, config: MapTrLossConfig
) -> Float[Array, "q l"]:
    """Return the cost of matching each query of one layer with each target; columns of padding are arbitrary."""
    by_class = focal_cost(prediction.logits, config.alpha, config.gamma)[:, targets.category]
    apart = order_distances(prediction.points, targets, range_).min(-1)
    return config.class_weight * by_class + config.points_weight * apart


def order_distances(
    points: Float[Array, "q p d"], targets: LineTargets, range_: PerceptionRange
) -> Float[Array, "q l o"]:
    """Return the L1 distance of each prediction to each order of each target, in fractions; infinite for no order."""
    lines, orders, count, size = targets.orders.shape
    found, true = range_.normalise(jnp.asarray(points)), range_.normalise(targets.orders)
    apart = pairwise_l1(found.reshape(-1, count * size), true.reshape(lines * orders, count * size))
    return jnp.where(targets.order_valid[None], apart.reshape(len(found), lines, orders), jnp.inf)


def line_losses(
    prediction: LinePrediction,
    assignment: Assignment,
    targets: LineTargets,
    range_: PerceptionRange,
    config: MapTrLossConfig,
) -> Terms:
    """Return the weighted losses of every layer of a batch."""
    each = jax.vmap(partial(_layer_sums, range_=range_, config=config), in_axes=(0, 0, None))
    sums = jax.vmap(each)(prediction, assignment, targets)  # each (B, D)
    weights = {
        "class": config.class_weight,
        "points": config.points_weight,
        "direction": config.direction_weight,
    }
    return {name: weight * sums[name].sum(0) / positives(assignment) for name, weight in weights.items()}


def _layer_sums(
    prediction: LinePrediction,
    assignment: Assignment,
    targets: LineTargets,
    range_: PerceptionRange,
    config: MapTrLossConfig,
) -> dict[str, Float[Array, ""]]:
    """Return the sums of losses over the queries of one layer of one example."""
    logits, lines = jnp.asarray(prediction.logits), jnp.asarray(prediction.points)[assignment.query]
    # Index `queries` lies outside, so unmatched targets write nowhere.
    query = jnp.where(assignment.matched, assignment.query, len(logits))
    true = nearest_order(lines, targets, range_)
    quality = None if config.class_target == "one" else line_quality(lines, true)
    classes = class_losses(logits, query, targets.category, quality, config.alpha, config.gamma)
    each = {
        "points": jnp.abs(range_.normalise(lines) - range_.normalise(true)).sum((1, 2)),
        "direction": direction_errors(lines, true, config.least_step).sum(1),
    }
    sums = {name: jnp.where(assignment.matched, value, 0.0).sum() for name, value in each.items()}
    return {"class": classes.sum()} | sums


def nearest_order(lines: Float[Array, "l p d"], targets: LineTargets, range_: PerceptionRange) -> Float[Array, "l p d"]:
    """Return for each target the order nearest to the line of the same index; no gradient flows through the choice."""
    scaled = range_.normalise(lax.stop_gradient(lines))[:, None]
    apart = jnp.abs(scaled - range_.normalise(targets.orders)).sum((2, 3))
    index = jnp.where(targets.order_valid, apart, jnp.inf).argmin(1)
    return jnp.take_along_axis(targets.orders, index[:, None, None, None], 1)[:, 0]


def direction_errors(
    lines: Float[Array, "*b p d"], truth: Float[Array, "*b p d"], least_step: float = 1e-6
) -> Float[Array, "*b s"]:
    """Return 1 - cos of the angle between the steps from point to point, S = P - 1; 1 for a step without length.

    Lengths a and b count as sqrt(a^2 + least_step^2), as in PyTorch's cosine.
    """
    a, b = jnp.diff(lines, axis=-2), jnp.diff(truth, axis=-2)
    scale = jnp.sqrt(((a**2).sum(-1) + least_step**2) * ((b**2).sum(-1) + least_step**2))
    return 1.0 - (a * b).sum(-1) / scale


def line_quality(lines: Float[Array, "l p d"], truth: Float[Array, "l p d"]) -> Float[Array, " l"]:
    """Return 1 / (1 + (d / 1 m)^2), where d is the mean distance of corresponding points, metres.

    d bounds the Chamfer distance between the points, which MapTR's metric compares with 0.5, 1 and 1.5 m.
    """
    distance = jnp.sqrt(((lines - truth) ** 2).sum(-1)).mean(-1)
    return 1.0 / (1.0 + distance**2)


def line_denoising_losses(
    prediction: LinePrediction, targets: LineTargets, range_: PerceptionRange, config: MapTrLossConfig
) -> Terms:
    """Return the `line_losses` of noised lines without matching: query i belongs to target i.

    Args:
        prediction: leading axes (batch, copy, layer); see `models.lane_denoising`.
        targets: ground truth; lines beyond the number of queries are left out.
        range_: see `line_loss`.
        config: weights.
    """
    prediction, assignment, targets = denoising_pairs(prediction, targets, targets.valid)
    return line_losses(prediction, assignment, targets, range_, config)
