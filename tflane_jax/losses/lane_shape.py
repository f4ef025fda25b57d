"""Hungarian fitting loss of lane curves: GTN paper, Eq. (3) and (4), with LSTR's weights (Liu et al. 2021)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float

from tflane_jax.geometry.lane_shapes import curve_columns
from tflane_jax.limits import Divisor, PositiveOrZero
from tflane_jax.losses.common import Report, matched
from tflane_jax.matching import Assignment, match
from tflane_jax.models.auxiliary import AuxiliaryOutputs
from tflane_jax.models.lstr import LstrConfig
from tflane_jax.scene import CurvePrediction, LaneLines, Prediction, RoadImage


@dataclass(frozen=True)
class LaneShapeLossConfig:
    """Weights of both matching costs and loss terms; the defaults are LSTR's.

    Attributes:
        class_weight: omega_1, weight of the classes.
        curve_weight: omega_2, for columns as fractions of the image width, summed over the points of a lane.
        extent_weight: omega_3, for the rows where a lane begins and ends.
        cell_weight: weight of the auxiliary loss on cells, for networks that have it; LSTR does not.
        shared_horizon: the target of every lane begins at the highest row of all lanes in the image, as in LSTR.
        least_depth: rows nearer to the predicted horizon than this fraction of the image height, above or below it,
            are evaluated this far below it. The curve has a pole at the horizon; with the default 1e-6 (LSTR's program
            has no bound), training rarely recovers from a predicted horizon close to a point's row. Scores, files and
            pictures have no such bound: the far end of a lane may bend in them where the loss saw no error.
        matcher: backend of `matching.match`.
    """

    class_weight: PositiveOrZero = 3.0
    curve_weight: PositiveOrZero = 5.0
    extent_weight: PositiveOrZero = 2.0
    cell_weight: PositiveOrZero = 10.0
    shared_horizon: bool = True
    least_depth: Divisor = 1e-6
    matcher: Literal["scipy", "jax"] = "jax"

    def loss(
        self, outputs: Prediction, auxiliary: AuxiliaryOutputs, batch: RoadImage, host: LstrConfig
    ) -> tuple[Float[Array, ""], Report]:
        """Return the loss of a batch and the numbers to record.

        Args:
            outputs: curves of every decoder layer, leading axes (batch, layer).
            auxiliary: auxiliary outputs, leading axis batch.
            batch: images with their lane lines, leading axis batch.
            host: the network's configuration.

        Raises:
            ValueError: the prediction has no curves.
        """
        if outputs.curves is None:
            raise ValueError("a lane-shape loss needs predicted curves")
        targets = lane_shape_targets(batch.lines, shared_horizon=self.shared_horizon)
        loss, terms = lane_shape_loss(outputs.curves, targets, self)
        if "line_cells" in host.auxiliary:
            cells = jnp.asarray(auxiliary.line_cells)
            terms["cells"] = self.cell_weight * jax.vmap(cell_loss)(cells, targets).mean()
            loss += terms["cells"]
        return loss, terms


@struct.dataclass
class LaneShapeTargets:
    """Lane lines as targets of the loss; any leading axes.

    Attributes:
        columns, rows: (L, P) u and v as fractions of the image; 0 where there is no point.
        point_valid: (L, P).
        extent: (L, 2) first and last row, alpha and beta of Eq. (8); 0 for invalid lanes.
        valid: (L,) lanes with at least one point.
    """

    columns: Float[Array, "*b l p"]
    rows: Float[Array, "*b l p"]
    point_valid: Bool[Array, "*b l p"]
    extent: Float[Array, "*b l 2"]
    valid: Bool[Array, "*b l"]


def lane_shape_targets(lines: LaneLines, *, shared_horizon: bool = True) -> LaneShapeTargets:
    """Return the targets of lane lines (any leading axes); padding may hold anything."""
    point_valid = lines.point_valid & lines.valid[..., None]
    valid = point_valid.any(-1)
    columns, rows = (jnp.where(point_valid, lines.points[..., i], 0.0) for i in range(2))
    first = jnp.where(point_valid, rows, jnp.inf).min(-1, initial=jnp.inf)
    last = jnp.where(point_valid, rows, -jnp.inf).max(-1, initial=-jnp.inf)
    if shared_horizon:
        first = jnp.broadcast_to(first.min(-1, keepdims=True, initial=jnp.inf), first.shape)
    extent = jnp.where(valid[..., None], jnp.stack([first, last], -1), 0.0)
    return LaneShapeTargets(columns, rows, point_valid, extent, valid)


def lane_weights(targets: LaneShapeTargets, counted: Bool[Array, "*b l"]) -> Float[Array, "*b l"]:
    """Return the weight of each lane of a batch: short lanes weigh more.

    w_l = sqrt(N / N_l) / max_i sqrt(N / N_i) = sqrt(min_i N_i / N_l), over the counted lanes of the whole batch.
    """
    points = targets.point_valid.sum(-1).astype(jnp.float32)
    least = jnp.where(counted, points, jnp.inf).min(initial=jnp.inf)
    return jnp.sqrt(jnp.where(counted, least / jnp.maximum(points, 1.0), 0.0))


def curve_errors(
    curves: Float[Array, "*layers q 8"], targets: LaneShapeTargets, least_depth: float
) -> Float[Array, "*layers q l"]:
    """Return the sum over points of |u(v) - column| of every curve to every lane of one example."""
    # Rows without a point are set to 1, far from any horizon.
    rows = jnp.where(targets.point_valid, targets.rows, 1.0)
    lead = curves.shape[:-1]
    columns = curve_columns(_shape(curves), rows.reshape(*(1,) * len(lead), -1), least_depth)
    errors = jnp.abs(columns.reshape(*lead, *rows.shape) - _lead(targets.columns, len(lead)))
    return jnp.where(_lead(targets.point_valid, len(lead)), errors, 0.0).sum(-1)


def cell_loss(logits: Float[Array, "h w"], targets: LaneShapeTargets) -> Float[Array, ""]:
    """Return the mean cross-entropy over one example's cells; a cell is positive if it contains a lane-line point.

    Cells of image padding count as empty.
    """
    height, width = logits.shape
    inside = targets.point_valid & (targets.columns >= 0) & (targets.columns < 1)
    inside &= (targets.rows >= 0) & (targets.rows < 1)
    # Index `height` lies outside, so other points write nowhere.
    row = jnp.where(inside, (targets.rows * height).astype(jnp.int32), height)
    column = jnp.where(inside, (targets.columns * width).astype(jnp.int32), 0)
    taken = jnp.zeros((height, width)).at[row, column].set(1.0, mode="drop")
    return optax.sigmoid_binary_cross_entropy(logits, taken).mean()


def matching_cost(
    prediction: CurvePrediction,
    targets: LaneShapeTargets,
    weights: Float[Array, " l"],
    config: LaneShapeLossConfig,
) -> Float[Array, "layers q l"]:
    """Return d(l, h) of Eq. (3) for one example: the cost of matching each lane with each query."""
    is_lane = jax.nn.softmax(prediction.logits)[..., 1:]
    fit = _lead(weights, 2) * curve_errors(prediction.curves, targets, config.least_depth)
    extent = jnp.abs(prediction.curves[..., None, :2] - _lead(targets.extent, 2)).sum(-1)
    return -config.class_weight * is_lane + config.curve_weight * fit + config.extent_weight * extent


def lane_shape_loss(
    prediction: CurvePrediction, targets: LaneShapeTargets, config: LaneShapeLossConfig
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Return the loss of a batch, Eq. (4) summed over decoder layers, and its terms.

    Args:
        prediction: outputs of every decoder layer, leading axes (batch, layer).
        targets: leading axis batch.
        config: weights.

    Returns:
        The total, and the weighted terms of the last layer: `class`, `curve`, `extent`; and `matching/lanes`, the
        mean number of matched lanes per example.
    """
    every = lane_weights(targets, targets.valid)
    cost = jax.vmap(lambda p, t, w: matching_cost(p, t, w, config))(prediction, targets, every)
    assignment = match(cost, targets.valid[:, None], config.matcher)  # z of Eq. (3), (B, D, L): one call of `match`
    # The weights of a layer use the lanes matched in that layer.
    weights = jax.vmap(lambda which: lane_weights(targets, which), in_axes=1, out_axes=1)(assignment.matched)
    per_layer = jax.vmap(jax.vmap(lambda p, a, w, t: _terms(p, a, w, t, config), in_axes=(0, 0, 0, None)))
    classes, curves, extents = per_layer(prediction, assignment, weights, targets)  # each (B, D)

    lanes = jnp.maximum(targets.valid.sum().astype(jnp.float32), 1.0)
    terms = {
        "class": config.class_weight * classes.mean(0),
        "curve": config.curve_weight * curves.sum(0) / lanes,
        "extent": config.extent_weight * extents.sum(0) / lanes,
    }
    total = jnp.stack(list(terms.values())).sum()
    report = {name: value[-1] for name, value in terms.items()}
    report["matching/lanes"] = matched(assignment)
    return total, report


def _terms(
    prediction: CurvePrediction,
    assignment: Assignment,
    weights: Float[Array, " l"],
    targets: LaneShapeTargets,
    config: LaneShapeLossConfig,
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return mean class loss, sum of curve errors and sum of extent errors of one layer of one example."""
    queries = prediction.logits.shape[0]
    # Index `queries` lies outside, so unmatched targets write nowhere.
    query = jnp.where(assignment.matched, assignment.query, queries)
    label = jnp.zeros(queries, jnp.int32).at[query].set(1, mode="drop")
    classes = optax.softmax_cross_entropy_with_integer_labels(prediction.logits, label).mean()

    chosen = prediction.curves[assignment.query]  # (L, 8)
    rows = jnp.where(targets.point_valid, targets.rows, 1.0)
    errors = jnp.abs(curve_columns(_shape(chosen), rows, config.least_depth) - targets.columns)
    curve = jnp.where(targets.point_valid & assignment.matched[:, None], errors, 0.0).sum(-1)
    extent = jnp.abs(chosen[:, :2] - targets.extent).sum(-1)
    return classes, (weights * curve).sum(), jnp.where(assignment.matched, extent, 0.0).sum()


def _shape(curves: Float[Array, "*b 8"]) -> Float[Array, "*b 6"]:
    """Return k'', f'', m'', n', b'', b''' of g_t, Eq. (8); predicted curves hold alpha and beta before them."""
    return curves[..., 2:]


def _lead(x, axes):
    """Return x with `axes` new leading axes."""
    return x.reshape((1,) * axes + x.shape)
