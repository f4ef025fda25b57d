"""LaneSegNet's costs and losses against the reference's numbers, and at their edges."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.converted import converted_params
from tests.golden import case_id, golden_modules, load_module_case, numbered
from tests.golden_compare import compare
from tests.models.cases import SEGMENTS, make_bucket_example, make_segment_example
from tests.slow import with_slow
from tflane_jax.convert.toponet import RELATIONSHIP
from tflane_jax.layers.graph import RelationshipHead
from tflane_jax.losses.costs import dice_cost, focal_cost, mask_cost
from tflane_jax.losses.lanesegnet import (
    LaneSegNetLossConfig,
    matching_cost,
    segment_loss,
    segment_quality,
    successor_loss,
)
from tflane_jax.losses.traffic_elements import ElementLossConfig
from tflane_jax.matching import Assignment, match
from tflane_jax.models.auxiliary import AuxiliaryOutputs
from tflane_jax.models.segment_truth import CROSSING, LANE, SegmentTargets
from tflane_jax.scene import ElementPrediction, Prediction, SegmentPrediction, stack_examples


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("laneseg_assigner*"), ids=case_id)
def test_assignment_matches_the_reference(path):
    case = load_module_case(path)
    queries, masks = len(case.inputs["cls_pred"]), case.inputs["gt_mask"]
    count = len(case.inputs["gt_lanes"])
    lines = case.inputs["lanes_pred"].reshape(queries, 3, -1, 3).swapaxes(0, 1)
    truth = case.inputs["gt_lanes"].reshape(count, 3, -1, 3).swapaxes(0, 1)
    prediction = SegmentPrediction(*lines, case.inputs["cls_pred"], mask_logits=case.inputs["mask_pred"])
    labels, config = case.inputs["gt_labels"], LaneSegNetLossConfig()
    targets = SegmentTargets(*truth, labels, labels, labels, np.zeros((count, count), bool), np.ones(count, bool))
    cost = jax.jit(lambda p, t: matching_cost(p, t, masks, config))(prediction, targets)
    np.testing.assert_allclose(cost, case.outputs["cost"], rtol=1e-4, atol=1e-4)
    logits, cells = (jnp.asarray(x.reshape(len(x), -1)) for x in (case.inputs["mask_pred"], masks))
    terms = {
        "cls_cost": config.class_weight * focal_cost(jnp.asarray(case.inputs["cls_pred"]))[:, labels],
        "mask_cost": config.mask_weight * mask_cost(logits, cells),
        "dice_cost": config.dice_weight * dice_cost(logits, cells),
    }
    for name, value in terms.items():
        np.testing.assert_allclose(value, case.outputs[name], rtol=1e-4, atol=1e-4, err_msg=name)
    assigned, own = np.zeros(queries, int), np.full(queries, -1)
    query = np.asarray(match(cost, targets.valid).query)
    assigned[query], own[query] = np.arange(count) + 1, labels
    np.testing.assert_array_equal(assigned, case.outputs["gt_inds"])
    np.testing.assert_array_equal(own, case.outputs["labels"])


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("laneseg_relationship_head*"), ids=case_id)
def test_topology_loss_matches_the_reference(path):
    case = load_module_case(path)
    images = range(len(numbered(case.inputs, r"gt_adj\.(\d+)")))
    every = [[case.inputs[f"{name}.{i}"] for name in ("gt_adj", "pos_inds", "pos_assigned_gt_inds")] for i in images]
    capacity = 1 + max(max(len(adjacency), *(targets + 1)) for adjacency, _, targets in every)
    truth, found = [], []
    for adjacency, queries, rows in every:
        count, line, label = len(adjacency), np.zeros((capacity, 2, 3)), np.zeros(capacity, np.int32)
        category = np.where(np.arange(capacity) < count, LANE, CROSSING)  # rows after the lanes
        successor, valid = np.zeros((capacity, capacity), bool), np.arange(capacity) < max(count, *(rows + 1))
        successor[:count, :count] = adjacency
        truth.append(SegmentTargets(line, line, line, category, label, label, successor, valid))
        assignment = Assignment(np.zeros(capacity, np.int32), np.zeros(capacity, bool))
        assignment.query[rows], assignment.matched[rows] = queries, True
        found.append(assignment)
    truth, found = stack_examples(truth), stack_examples(found)
    hidden = numbered(case.params, r"MLP_o1\.layers\.(\d+)\.bias")
    head = RelationshipHead(len(case.params[hidden[-1]]))

    def outputs(torch_params, inputs):
        params = {"params": converted_params(torch_params, RELATIONSHIP)}
        logits = jax.vmap(lambda a, b: head.apply(params, a, b))(inputs["o1_feats"][-1], inputs["o2_feats"][-1])
        loss = successor_loss(logits, found, truth, LaneSegNetLossConfig())
        return {"rel_pred": logits[..., None], "loss_rel": loss}

    compare(case, outputs)


QUERIES, POINTS, CELLS = 5, 4, (3, 4)


def make_case(seed=0, counts=(2, 3, 0), capacity=4, garbage=0.0):
    """Return predictions of two layers, targets and masks; padding of the targets' arrays that may hold anything."""
    rng = np.random.default_rng(seed)
    batch = len(counts)
    draw = lambda *shape: rng.normal(size=(batch, 2, QUERIES, *shape)).astype(np.float32)  # noqa: E731
    prediction = SegmentPrediction(
        *(8.0 * draw(POINTS, 3) for _ in range(3)), draw(2), draw(3), draw(3), draw(*CELLS), draw(QUERIES)[:, 1:]
    )
    valid = np.arange(capacity) < np.array(counts)[:, None]
    line = lambda: np.where(valid[..., None, None], 8.0 * rng.normal(size=(batch, capacity, POINTS, 3)), garbage)  # noqa: E731
    label = lambda n: rng.integers(0, n, (batch, capacity)).astype(np.int32)  # noqa: E731
    category = np.where(np.arange(capacity) == 1, CROSSING, LANE).astype(np.int32) * np.ones((batch, 1), np.int32)
    edges = rng.random((batch, capacity, capacity)) < 0.4
    lane = valid & (category == LANE)
    targets = SegmentTargets(
        *(line().astype(np.float32) for _ in range(3)),
        category,
        label(3),
        label(3),
        edges & lane[:, :, None] & lane[:, None],
        valid,
    )
    masks = (rng.random((batch, capacity, *CELLS)) < 0.4) & valid[..., None, None]
    return jax.tree.map(jnp.asarray, (prediction, targets, masks.astype(np.float32)))


@partial(jax.jit, static_argnums=3)
def jitted(prediction, targets, masks, config):
    return segment_loss(prediction, targets, masks, config)


def test_the_order_of_queries_and_targets_does_not_matter():
    prediction, targets, masks = make_case()
    loss, report = jitted(prediction, targets, masks, LaneSegNetLossConfig())
    order, rows = np.array([3, 0, 4, 1, 2]), np.array([2, 3, 0, 1])
    shuffled = jax.tree.map(lambda leaf: leaf[:, :, order], prediction)
    shuffled = shuffled.replace(successor_logits=shuffled.successor_logits[..., order])
    moved = jax.tree.map(lambda leaf: leaf[:, rows], (targets, masks))
    moved = moved[0].replace(successor=moved[0].successor[..., rows]), moved[1]
    for changed in ((shuffled, targets, masks), (prediction, *moved)):
        other, terms = jitted(*changed, LaneSegNetLossConfig())
        np.testing.assert_allclose(other, loss, rtol=1e-5)
        for name, value in report.items():
            np.testing.assert_allclose(terms[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


def mirrored(lines, grid):
    """Left becomes right: y changes its sign, and rows of the grid their order."""
    return lines * np.array([1.0, -1.0, 1.0], np.float32), grid[..., ::-1, :]


def turned(lines, grid):
    """A quarter turn to the left: the grid, seen from above with x to the right and y up, turns with the lanes."""
    return np.stack([-lines[..., 1], lines[..., 0], lines[..., 2]], -1), np.flip(grid.swapaxes(-1, -2), -1)


def shifted(lines, grid):
    """Elsewhere; the grid goes along."""
    return lines + np.array([7.5, -3.25, 0.5], np.float32), grid


@pytest.mark.parametrize("motion", [mirrored, turned, shifted])
@pytest.mark.parametrize("class_target", ["one", "quality"])
def test_a_mirrored_or_moved_scene_has_the_same_loss(motion, class_target):
    prediction, targets, masks = jax.tree.map(np.asarray, make_case(4))
    config = LaneSegNetLossConfig(class_target=class_target)

    def move(scene, grid):
        sides = {name: motion(getattr(scene, name), grid)[0] for name in ("points", "left", "right")}
        if motion is mirrored:
            sides |= {"left": sides["right"], "right": sides["left"]}
            kinds = "left_type", "right_type"
            if isinstance(scene, SegmentPrediction):
                kinds = "left_type_logits", "right_type_logits"
            sides |= dict(zip(kinds, (getattr(scene, kind) for kind in kinds[::-1]), strict=True))
        return scene.replace(**sides), motion(scene.points, grid)[1]

    moved, grid = move(prediction, prediction.mask_logits)
    loss, report = jitted(prediction, targets, masks, config)
    other, terms = jitted(moved.replace(mask_logits=grid), *move(targets, masks), config)
    np.testing.assert_allclose(other, loss, rtol=1e-5)
    for name, value in report.items():
        np.testing.assert_allclose(terms[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("class_target", with_slow(["one", "quality"], quick=["quality"]))
@pytest.mark.parametrize("counts", [(0, 0), pytest.param((1, 0), marks=pytest.mark.slow), (4, 1)])
def test_any_number_of_targets_has_a_finite_gradient(counts, class_target):
    prediction, targets, masks = make_case(1, counts)
    config = LaneSegNetLossConfig(class_target=class_target)
    gradient, report = jax.jit(jax.grad(lambda p: segment_loss(p, targets, masks, config), has_aux=True))(prediction)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert float(report["matching/segments"]) == sum(counts) / 2
    if not any(counts):
        assert all(float(report[name]) == 0.0 for name in ("points", "mask", "dice", "successor"))
        assert float(report["class"]) > 0.0


def test_no_capacity_is_no_target():
    prediction, targets, masks = make_case(2, (0, 0), 4)
    none = jax.tree.map(lambda leaf: leaf[:, :0], (targets, masks))
    none = none[0].replace(successor=none[0].successor[..., :0]), none[1]
    full, empty = (
        jitted(prediction, targets, masks, LaneSegNetLossConfig()),
        jitted(prediction, *none, LaneSegNetLossConfig()),
    )
    np.testing.assert_allclose(full[0], empty[0], rtol=1e-6)


def test_a_perfect_prediction_costs_next_to_nothing_and_quality_falls_with_distance():
    _, targets, masks = make_case(3, (2, 2), 4)
    pad = lambda x: jnp.repeat(jnp.pad(x, ((0, 0), (0, 1), *((0, 0),) * (x.ndim - 2)))[:, None], 2, 1)  # noqa: E731
    sure = lambda labels, count: 40.0 * jax.nn.one_hot(labels, count) - 20.0  # noqa: E731
    valid = pad(targets.valid)[..., None]
    types = [jnp.where(valid, pad(sure(label, 3)), -20.0) for label in (targets.left_type, targets.right_type)]
    perfect = SegmentPrediction(
        *(pad(line) for line in (targets.points, targets.left, targets.right)),
        jnp.where(valid, pad(sure(targets.category, 2)), -20.0),
        *types,
        40.0 * pad(masks) - 20.0,
        jnp.pad(40.0 * targets.successor - 20.0, ((0, 0), (0, 1), (0, 1)))[:, None],
    )
    loss, report = jitted(perfect, targets, masks, LaneSegNetLossConfig(class_target="quality"))
    assert float(loss) < 1e-3, report
    assert float(report["matching/segments"]) == 2.0
    lines = jnp.zeros((3, 3, POINTS, 3))
    moved = lines.at[1, 0, 2, 0].set(2.0).at[2, 1, 0, 1].set(2.0)  # centerline, left boundary
    np.testing.assert_allclose(segment_quality(moved, lines), [1.0, 0.75, 0.875])


@pytest.mark.slow
def test_topology_counts_matched_pairs_of_lanes():
    logits = jnp.zeros((1, 3, 3))
    found = Assignment(jnp.array([[2, 0, 1, 0]]), jnp.array([[True, True, True, False]]))
    line, label = jnp.zeros((1, 4, 2, 3)), jnp.zeros((1, 4), jnp.int32)
    edges = jnp.zeros((1, 4, 4), bool).at[0, 0, 2].set(True)
    category = jnp.array([[LANE, CROSSING, LANE, LANE]])
    targets = SegmentTargets(line, line, line, category, label, label, edges, jnp.ones((1, 4), bool))
    # Rows 0 and 2 are matched lanes: one edge and three pairs without, each -log 0.5 times alpha or 1 - alpha, / 4.
    # The published mean is over the pairs without an edge.
    total = (0.25 + 3 * 0.75) * np.log(2) / 4
    config = LaneSegNetLossConfig(successor_weight=1.0)
    np.testing.assert_allclose(successor_loss(logits, found, targets, config), total / 3, rtol=1e-5)


def test_padding_of_the_examples_may_hold_nan():
    config, host = LaneSegNetLossConfig(), SEGMENTS
    example = make_segment_example(2, lanes=3)
    module = host.build()
    outputs = jax.eval_shape(lambda key: module.init_with_output(key, example, train=True)[0], jax.random.key(0))
    rng = np.random.default_rng(0)
    outputs = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=(1, *leaf.shape)), leaf.dtype), outputs)
    valid, there = example.segments.valid[:, None, None], example.areas.valid[:, None, None]
    dirty = example.replace(
        segments=example.segments.replace(
            **{name: np.where(valid, getattr(example.segments, name), np.nan) for name in ("points", "left", "right")}
        ),
        areas=example.areas.replace(points=np.where(there, example.areas.points, np.nan)),
    )
    run = jax.jit(lambda batch: config.loss(outputs, AuxiliaryOutputs(), batch, host))
    clean, other = run(stack_examples([example])), run(stack_examples([dirty]))
    jax.tree.map(np.testing.assert_array_equal, clean, other)
    assert np.isfinite(clean[0])


@pytest.mark.slow
def test_published_class_losses_are_divided_by_the_rows_of_their_own_frame():
    """Classes, line types and topology, as of devices with one frame each; the other terms as of one batch."""
    case = make_case(counts=(2, 4, 1))
    config = LaneSegNetLossConfig(class_mean="frame")
    alone = [
        jitted(*jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], case), LaneSegNetLossConfig())[1] for i in range(3)
    ]
    report, batch = (jitted(*case, each)[1] for each in (config, LaneSegNetLossConfig()))
    for name in ("class", "line_type", "successor"):
        np.testing.assert_allclose(report[name], np.mean([terms[name] for terms in alone]), rtol=1e-5, err_msg=name)
        assert abs(float(report[name] - batch[name])) > 0.02 * float(batch[name]), name
    for name in ("points", "mask", "dice"):
        np.testing.assert_array_equal(report[name], batch[name])


@pytest.mark.slow
def test_elements_count_as_matched_pairs_and_not_at_all_in_a_frame_without_any():
    """The map-element-bucket variant: its topology has the loss of the successors."""
    host = replace(SEGMENTS, decoder=replace(SEGMENTS.decoder, classes=1))
    example, none = make_bucket_example(0), make_bucket_example(0, elements=0)
    points, rng = example.segments.points.shape[1], np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(rng.normal(size=(1, 1, *shape)), jnp.float32)  # noqa: E731
    lines, types = [draw(6, points, 3) for _ in range(3)], [draw(6, 3) for _ in range(2)]
    segments = SegmentPrediction(*lines, draw(6, 1), *types, draw(6, *CELLS), draw(6, 6))
    outputs = Prediction(segments=segments, elements=ElementPrediction(draw(5, 2, 2), draw(5, 13), draw(6, 5)))
    config = LaneSegNetLossConfig(matcher="scipy", elements=ElementLossConfig(empty_frames="skip"))

    @jax.jit
    def run(batch):
        def loss(logits):
            found = outputs.replace(elements=outputs.elements.replace(lane_logits=logits))
            return config.loss(found, AuxiliaryOutputs(), batch, host)

        return jax.value_and_grad(loss, has_aux=True)(outputs.elements.lane_logits)

    (_, report), gradient = run(stack_examples([example]))
    pairs = np.argwhere(gradient[0, 0])
    assert len(pairs) == 4 * 2  # of the queries of four segments and of two elements
    assert (len(set(pairs[:, 0])), len(set(pairs[:, 1]))) == (4, 2)
    assert float(report["element_class"]) > 0.0
    edges = int((example.traffic_elements.segment & example.segments.valid[:, None]).sum())
    assert 0 < edges < 8
    # By hand, over the pairs without an edge; which pairs have one follows from the gradient's sign.
    x, rising = np.asarray(outputs.elements.lane_logits)[0, 0][tuple(pairs.T)], gradient[0, 0][tuple(pairs.T)] > 0
    p = 1 / (1 + np.exp(-x))
    focal = np.where(rising, 0.75 * p**2 * -np.log(1 - p), 0.25 * (1 - p) ** 2 * -np.log(p))
    assert (~rising).sum() == edges
    np.testing.assert_allclose(report["element_lane"], 5.0 * focal.sum() / (8 - edges), rtol=1e-5)

    (_, report), gradient = run(stack_examples([none]))
    assert not np.any(gradient)
    assert all(float(report[f"element_{name}"]) == 0.0 for name in ("class", "box", "iou", "lane"))
    assert float(report["class"]) > 0.0
