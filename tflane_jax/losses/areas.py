"""Loss of crossings and road boundaries that have a decoder of their own (LaneSegNet's map-element-bucket variant).

It is MapTR's loss of lines with other weights: classes, L1 on points in metres, and directions of the steps, over the
equivalent orders of rings and open lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.line_orders import Ways, point_orders
from tflane_jax.limits import Divisor, PositiveOrZero
from tflane_jax.losses.common import Report
from tflane_jax.losses.maptr import LineTargets, MapTrLossConfig, line_loss
from tflane_jax.scene import AreaPrediction, Areas, AreaType, LinePrediction

# Metres as they are: the published L1 is not normalised.
_METRES = PerceptionRange((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
# Metres between the first and the last point of a ring.
_CLOSED = 0.01


@dataclass(frozen=True)
class AreaLossConfig:
    """Weights of matching costs and loss terms; the defaults are the variant's.

    Attributes:
        class_weight, points_weight: weights of both cost and loss; points in metres, summed over coordinates.
        direction_weight, least_step: see `MapTrLossConfig`.
        rings: directions in which a true ring may be matched.
        class_target: see `MapTrLossConfig`.
    """

    class_weight: PositiveOrZero = 1.5
    points_weight: PositiveOrZero = 0.025
    direction_weight: PositiveOrZero = 0.005
    least_step: Divisor = 1e-6
    rings: Ways = "one"
    class_target: Literal["one", "quality"] = "one"


def area_targets(areas: Areas, rings: Ways = "one") -> LineTargets:
    """Return the targets of one example; padding may hold anything. Crossings are class 0, boundaries class 1."""
    valid = jnp.asarray(areas.valid)
    points = jnp.where(valid[:, None, None], jnp.asarray(areas.points), 0.0)
    closed = jnp.abs(points[:, 0] - points[:, -1]).max(-1) < _CLOSED
    orders, order_valid = point_orders(points, closed, None, rings)
    category = jnp.where(valid, jnp.asarray(areas.category) - int(AreaType.PEDESTRIAN_CROSSING), 0)
    return LineTargets(orders, order_valid, category, valid)


def area_loss(
    prediction: AreaPrediction, areas: Areas, config: AreaLossConfig, matcher: Literal["scipy", "jax"]
) -> tuple[Float[Array, ""], Report]:
    """Return the loss of a batch and its terms, under `area_class`, `area_points`, `area_direction`; `matching/areas`.

    Args:
        prediction: outputs of every decoder layer, leading axes (batch, layer).
        areas: ground truth, leading axis batch; crossings are closed rings.
        config: weights.
        matcher: backend of `matching.match`.
    """
    targets = jax.vmap(lambda area: area_targets(area, config.rings))(areas)
    weights = MapTrLossConfig(
        class_weight=config.class_weight,
        points_weight=config.points_weight,
        direction_weight=config.direction_weight,
        least_step=config.least_step,
        matcher=matcher,
        class_target=config.class_target,
    )
    loss, report = line_loss(LinePrediction(prediction.points, prediction.logits), targets, _METRES, weights)
    names = {"matching/lines": "matching/areas"} | {name: f"area_{name}" for name in ("class", "points", "direction")}
    return loss, {names[name]: value for name, value in report.items()}
