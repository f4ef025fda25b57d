"""MapTR's costs and losses against the reference's numbers, their symmetries, and their edges."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, implemented, load_module_case, options
from tests.golden_compare import compare
from tests.models.cases import LINES, make_line_example
from tests.models.golden_maps import line_targets as golden_targets
from tests.models.golden_maps import perception_range
from tests.slow import with_slow
from tflane_jax.datasets.map_geometry import MapGeometry
from tflane_jax.datasets.map_lines import MapLinesConfig, crop_map_lines
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange, resample
from tflane_jax.losses.costs import focal_cost
from tflane_jax.losses.maptr import (
    LineTargets,
    MapTrLossConfig,
    direction_errors,
    line_loss,
    line_quality,
    line_targets,
    matching_cost,
    nearest_order,
    order_distances,
)
from tflane_jax.matching import match
from tflane_jax.models.auxiliary import AuxiliaryOutputs
from tflane_jax.scene import LineClass, LinePrediction, MapLines, Prediction, stack_examples

RANGE = PerceptionRange((-30.0, 30.0), (-15.0, 15.0), (-2.0, 2.0))


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("maptr_assigner*"), ids=case_id)
def test_assignment_matches_the_reference(path):
    case = load_module_case(path)
    found = options(case, "cls_cost", "pts_cost", "reg_cost", "iou_cost")
    # Boxes cost nothing in the published configurations.
    assert found.reg_cost["weight"] == found.iou_cost["weight"] == 0.0
    implemented(case, type=["MapTRAssigner"])
    config = MapTrLossConfig(class_weight=found.cls_cost["weight"], points_weight=found.pts_cost["weight"])
    range_, labels = perception_range(case), case.inputs["gt_labels"]
    targets = golden_targets(case.inputs["gt_shift_pts"], labels, len(labels))
    # The reference takes predictions in fractions of the range.
    prediction = LinePrediction(range_.denormalise(case.inputs["pts_pred"]), case.inputs["cls_pred"])

    @jax.jit
    def run(prediction, targets):
        return matching_cost(prediction, targets, range_, config), order_distances(prediction.points, targets, range_)

    cost, apart = run(prediction, targets)
    np.testing.assert_allclose(cost, case.outputs["cost"], rtol=1e-4, atol=1e-4)
    by_class = config.class_weight * focal_cost(jnp.asarray(case.inputs["cls_pred"]))[:, labels]
    np.testing.assert_allclose(by_class, case.outputs["cls_cost"], rtol=1e-4, atol=1e-4)
    real = np.broadcast_to(np.asarray(targets.order_valid), apart.shape)
    expected = case.outputs["pts_cost_ordered"]
    np.testing.assert_allclose(config.points_weight * np.asarray(apart)[real], expected[real], rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(np.asarray(apart).argmin(-1), case.outputs["order_index"])
    assigned, own = np.zeros(len(cost), int), np.full(len(cost), -1)
    query = np.asarray(match(cost, targets.valid).query)
    assigned[query], own[query] = np.arange(len(labels)) + 1, labels
    np.testing.assert_array_equal(assigned, case.outputs["gt_inds"])
    np.testing.assert_array_equal(own, case.outputs["labels"])


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("maptr_losses*"), ids=case_id)
def test_losses_match_the_reference(path):
    case = load_module_case(path)
    config, count = MapTrLossConfig(), 4.0  # the fixture's avg_factor

    def outputs(_, inputs):
        lines, truth, weight = (jnp.asarray(inputs[name]) for name in ("pred", "target", "weight"))
        errors = direction_errors(lines, truth)
        apart = jnp.abs(lines[:, None] - inputs["target_orders"]) * weight[:, None]
        return {
            "pts_l1": config.points_weight * (jnp.abs(lines - truth) * weight).sum() / count,
            "dir_cos": config.direction_weight * (errors * weight[:, 1:, 0]).sum() / count,
            "dir_cos_elem": errors,
            "ordered_l1": apart.sum((0, 2, 3)) / count,
        }

    compare(case, outputs)


QUERIES, POINTS = 7, 6


def make_lines(seed=0, counts=(3, 5, 0), capacity=6, garbage=0.0):
    """Return the map lines of a batch, the second of every example a ring; padding may hold anything."""
    rng = np.random.default_rng(seed)
    shape = (len(counts), capacity)
    points = rng.uniform(-1, 1, (*shape, POINTS, 3)) * [25.0, 12.0, 1.0]
    closed = np.zeros(shape, bool)
    closed[:, 1] = True
    points[:, 1, -1] = points[:, 1, 0]
    valid = np.arange(capacity) < np.array(counts)[:, None]
    points = np.where(valid[..., None, None], points, garbage).astype(np.float32)
    category = np.where(valid, rng.integers(0, 3, shape), 9 if garbage else 0).astype(np.int32)
    return MapLines(points, category, closed, valid)


def make_prediction(seed=0, batch=3, coordinates=2):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (batch, 2, QUERIES, POINTS, 3)) * [25.0, 12.0, 1.0]
    logits = rng.normal(size=(batch, 2, QUERIES, 3))
    return LinePrediction(*(jnp.asarray(x, jnp.float32) for x in (points[..., :coordinates], logits)))


@partial(jax.jit, static_argnames=("config",))
def jitted(prediction, lines, config):
    coordinates = prediction.points.shape[-1]
    targets = jax.vmap(partial(line_targets, coordinates=coordinates, classes=3, rings=config.rings))(lines)
    return line_loss(prediction, targets, RANGE, config)


def same_loss(prediction, lines, other, config):
    (loss, report), (changed, terms) = jitted(prediction, lines, config), jitted(prediction, other, config)
    np.testing.assert_allclose(changed, loss, rtol=1e-5)
    for name, value in report.items():
        np.testing.assert_allclose(terms[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("rings", ["one", "both"])
@pytest.mark.parametrize("coordinates", with_slow([2, 3], quick=[3]))
@pytest.mark.parametrize("steps", with_slow([1, 3], quick=[3]))
def test_a_ring_may_start_anywhere_and_a_line_at_either_end(rings, coordinates, steps):
    prediction, lines = make_prediction(coordinates=coordinates), make_lines()
    config = MapTrLossConfig(rings=rings)
    points, ring = lines.points.copy(), lines.points[:, 1, :-1]
    moved = np.roll(ring, steps, 1)
    points[:, 1] = np.concatenate([moved, moved[:, :1]], 1)
    points[:, 0] = points[:, 0, ::-1]
    assert not np.array_equal(points[:2, 1], lines.points[:2, 1])
    same_loss(prediction, lines, lines.replace(points=points), config)


HOUSE = np.array([[3, -4, 0], [11, -5, 0], [12, 3, 0], [7, 8, 0], [2, 4, 0], [3, -4, 0]], float)


def cropped(ring):
    """Return the map lines of a map with one crossing, as a batch of one."""
    geometry, nothing = MapGeometry.of(crossings=[[ring]]), {"boxes": np.zeros((0, 7)), "buildings": np.zeros((0, 5))}
    lines, _ = crop_map_lines(geometry, np.eye(4), RANGE, MapLinesConfig(lines=6, points=POINTS), **nothing)
    return jax.tree.map(lambda leaf: leaf[None], lines)


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_the_source_may_start_a_ring_at_any_corner_and_turn_it_either_way(steps):
    """Rings are resampled from their first corner and run clockwise, so that one direction is enough."""
    prediction, config = make_prediction(batch=1), MapTrLossConfig()
    corners = np.roll(HOUSE[:-1], steps, 0)
    ring = np.concatenate([corners, corners[:1]])
    for other in (ring, ring[::-1]):
        same_loss(prediction, cropped(HOUSE), cropped(other), config)
    # Resampled as the source has them, the rings have other points and another loss.
    plain = [cropped(HOUSE).replace(points=resample(one, POINTS)[None, None].repeat(6, 1)) for one in (HOUSE, ring)]
    one, two = (float(jitted(prediction, lines, config)[0]) for lines in plain)
    assert abs(one - two) > 1e-4 * one


def test_a_ring_may_turn_either_way_only_if_the_configuration_says_so():
    prediction, lines = make_prediction(), make_lines()
    points = lines.points.copy()
    points[:, 1] = points[:, 1, ::-1]
    turned = lines.replace(points=points)
    same_loss(prediction, lines, turned, MapTrLossConfig(rings="both"))
    loss, other = (float(jitted(prediction, each, MapTrLossConfig())[0]) for each in (lines, turned))
    assert abs(loss - other) > 1e-3 * loss


def test_a_centerline_has_one_direction():
    lines = make_lines(counts=(1,))
    lines = lines.replace(category=np.full_like(lines.category, LineClass.CENTERLINE))
    prediction = make_prediction(batch=1)
    prediction = prediction.replace(logits=jnp.zeros((1, 2, QUERIES, 4)))
    backwards = lines.replace(points=lines.points[:, :, ::-1].copy())

    @jax.jit
    def run(lines):
        targets = jax.vmap(partial(line_targets, coordinates=2, classes=4))(lines)
        return line_loss(prediction, targets, RANGE, MapTrLossConfig())[0]

    assert abs(float(run(lines)) - float(run(backwards))) > 0.1
    # A model without that class does not learn it.
    assert float(jitted(make_prediction(batch=1), lines, MapTrLossConfig())[1]["matching/lines"]) == 0.0


def test_the_order_of_queries_and_lines_does_not_matter():
    prediction, lines = make_prediction(), make_lines()
    order, rows = np.array([3, 0, 6, 4, 1, 5, 2]), np.array([2, 3, 0, 5, 1, 4])
    shuffled = jax.tree.map(lambda leaf: leaf[:, :, order], prediction)
    loss, report = jitted(prediction, lines, MapTrLossConfig())
    for changed in ((shuffled, lines), (prediction, jax.tree.map(lambda leaf: leaf[:, rows], lines))):
        other, terms = jitted(*changed, MapTrLossConfig())
        np.testing.assert_allclose(other, loss, rtol=1e-5)
        for name, value in report.items():
            np.testing.assert_allclose(terms[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("class_target", with_slow(["one", "quality"], quick=["quality"]))
@pytest.mark.parametrize("counts", [(0, 0), (1, 0), (6, 1)])
def test_any_number_of_lines_has_a_finite_gradient(counts, class_target):
    prediction, lines = make_prediction(1, 2), make_lines(1, counts)
    config = MapTrLossConfig(class_target=class_target)
    gradient, report = jax.jit(jax.grad(lambda p: jitted(p, lines, config), has_aux=True))(prediction)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert float(report["matching/lines"]) == sum(counts) / 2
    if not any(counts):
        assert float(report["points"]) == float(report["direction"]) == 0.0
        assert float(report["class"]) > 0.0


def test_padding_may_hold_anything_and_no_capacity_is_no_line():
    prediction, config = make_prediction(), MapTrLossConfig(rings="both")
    clean, dirty = make_lines(), make_lines(garbage=np.nan)
    jax.tree.map(np.testing.assert_array_equal, jitted(prediction, clean, config), jitted(prediction, dirty, config))
    none = make_lines(counts=(0, 0, 0))
    empty = jax.tree.map(lambda leaf: leaf[:, :0], none)
    np.testing.assert_allclose(jitted(prediction, none, config)[0], jitted(prediction, empty, config)[0], rtol=1e-6)


def test_a_perfect_prediction_in_any_order_costs_next_to_nothing():
    lines = make_lines(3, (2, 2), 2)
    reordered = lines.points[..., :2].copy()
    reordered[:, 0] = reordered[:, 0, ::-1]
    reordered[:, 1, :] = np.concatenate([reordered[:, 1, 2:], reordered[:, 1, 1:3]], 1)
    pad = lambda x: jnp.repeat(jnp.pad(x, ((0, 0), (0, 1), *((0, 0),) * (x.ndim - 2)))[:, None], 2, 1)  # noqa: E731
    logits = jnp.where(pad(lines.valid)[..., None], pad(40.0 * jax.nn.one_hot(lines.category, 3) - 20.0), -20.0)
    loss, report = jitted(LinePrediction(pad(reordered), logits), lines, MapTrLossConfig(class_target="quality"))
    assert float(loss) < 1e-3, report
    assert float(report["matching/lines"]) == 2.0


@pytest.mark.parametrize(("least_step", "most"), [(1e-9, 2e9), (1e-6, 2e6), (0.1, 20.0)])
def test_coinciding_points_have_a_direction_with_a_bounded_gradient(least_step, most):
    truth = jnp.asarray(np.arange(4.0, dtype=np.float32)[:, None] * [1.0, 0.0])
    lines = truth.at[2].set(truth[1])
    run = jax.jit(jax.value_and_grad(lambda x: direction_errors(x, truth, least_step).sum()))
    value, gradient = run(lines)
    np.testing.assert_allclose(value, 1.0, atol=0.02)
    assert most / 4 < np.abs(gradient).max() < most
    # Padding of the truth has no direction either.
    nowhere = jnp.zeros_like(truth)
    assert not np.asarray(jax.grad(lambda x: direction_errors(x, nowhere, least_step).sum())(nowhere)).any()


def test_the_nearest_order_is_so_in_fractions_of_the_range():
    """3 m along the 60 m of the range are less than 2 m along its 30 m."""
    orders = jnp.array([[[[3.0, 0.0]] * 4, [[0.0, 2.0]] * 4]])
    targets = LineTargets(orders, jnp.ones((1, 2), bool), jnp.zeros(1, int), jnp.ones(1, bool))
    np.testing.assert_array_equal(nearest_order(jnp.zeros((1, 4, 2)), targets, RANGE), orders[:, 0])


def test_quality_falls_with_the_mean_distance_of_the_nearest_order():
    truth = np.zeros((2, 4, 2), np.float32)
    moved = truth.copy()
    moved[1, :2] = [2.4, 3.2]  # half of the points by 4 m
    np.testing.assert_allclose(line_quality(jnp.asarray(moved), jnp.asarray(truth)), [1.0, 0.2], rtol=1e-6)
    orders = jnp.stack([jnp.asarray(truth) + 9.0, jnp.asarray(moved)], 1)
    targets = LineTargets(orders, jnp.array([[True, True], [True, False]]), jnp.zeros(2, jnp.int32), jnp.ones(2, bool))
    chosen = nearest_order(jnp.asarray(moved), targets, RANGE)
    np.testing.assert_array_equal(chosen, np.stack([moved[0], truth[1] + 9.0]))


def test_padding_of_the_examples_may_hold_nan_and_missing_truth_is_named():
    config, host = MapTrLossConfig(), LINES
    example = make_line_example(2)
    module = host.build()
    outputs = jax.eval_shape(lambda key: module.init_with_output(key, example, train=True)[0], jax.random.key(0))
    rng = np.random.default_rng(0)
    outputs = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=(1, *leaf.shape)), leaf.dtype), outputs)
    lines = example.map_lines
    dirty = lines.replace(points=np.where(lines.valid[:, None, None], lines.points, np.nan))
    run = jax.jit(lambda batch: config.loss(outputs, AuxiliaryOutputs(), batch, host))
    clean = run(stack_examples([example]))
    jax.tree.map(np.testing.assert_array_equal, clean, run(stack_examples([example.replace(map_lines=dirty)])))
    assert np.isfinite(clean[0])
    with pytest.raises(UserError, match="map_lines is None"):
        config.loss(outputs, AuxiliaryOutputs(), stack_examples([example.replace(map_lines=None)]), host)
    with pytest.raises(ValueError, match="predicted map lines"):
        config.loss(Prediction(), AuxiliaryOutputs(), stack_examples([example]), host)
