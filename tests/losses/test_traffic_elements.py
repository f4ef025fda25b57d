"""Losses of traffic elements against plain loops; lane-element topology of the last layers only; Bezier lanes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from tests.losses.test_toponet import BATCH, LAYERS, QUERIES, focal, make_case
from tflane_jax.geometry.bezier import bezier_fit
from tflane_jax.losses.costs import generalised_iou
from tflane_jax.losses.toponet import TopoNetLossConfig, lane_graph_loss, matching_cost
from tflane_jax.losses.traffic_elements import ElementLossConfig
from tflane_jax.scene import ElementPrediction, Prediction, TrafficElements, stack_examples

ELEMENTS, FOUND = 3, 4
SIZES = np.array([[96, 64], [80, 48], [64, 64]], np.int32)


@partial(jax.jit, static_argnums=4)
def value_and_gradient(prediction, lanes, elements, sizes, config):
    return jax.value_and_grad(lambda p: lane_graph_loss(p, lanes, config, elements, sizes), has_aux=True)(prediction)


def make_elements(seed, counts, related):
    """Return predicted and true elements, and lanes that some of them govern."""
    rng = np.random.default_rng(seed)
    lanes, truth = make_case(seed)
    elements = []
    for count in counts:
        one = TrafficElements.empty(ELEMENTS, truth.valid.shape[1])
        low = rng.uniform(0, 30, (ELEMENTS, 2))
        box = np.stack([low, low + rng.uniform(4, 18, (ELEMENTS, 2))], 1).astype(np.float32)
        elements.append(
            one.replace(
                box=box,
                attribute=rng.integers(0, 13, ELEMENTS).astype(np.int32),
                lane=rng.random(one.lane.shape) < 0.5,
                valid=rng.permutation(ELEMENTS) < count,
            )
        )
    low = rng.uniform(0, 30, (BATCH, LAYERS, FOUND, 2))
    found = ElementPrediction(
        box=np.stack([low, low + rng.uniform(4, 18, low.shape)], -2).astype(np.float32),
        logits=rng.normal(size=(BATCH, LAYERS, FOUND, 13)).astype(np.float32),
        lane_logits=rng.normal(size=(BATCH, related, QUERIES, FOUND)).astype(np.float32),
    )
    lanes = lanes.replace(successor_logits=lanes.successor_logits[:, LAYERS - related :])
    return Prediction(centerlines=lanes, elements=jax.tree.map(jnp.asarray, found)), truth, stack_examples(elements)


def overlap(a, b):
    """Generalised IoU of two boxes by counting: areas of union and hull."""
    side = np.clip(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0, None)
    union = np.prod(a[1] - a[0]) + np.prod(b[1] - b[0]) - np.prod(side)
    hull = np.prod(np.maximum(a[1], b[1]) - np.minimum(a[0], b[0]))
    return np.prod(side) / union - (hull - union) / hull


def fractions(box, size):
    return np.concatenate([box.mean(0) / size, (box[1] - box[0]) / size])


def assign(cost):
    rows, columns = linear_sum_assignment(cost)
    return dict(zip(columns.tolist(), rows.tolist(), strict=True))


def loop_terms(prediction, lanes, elements, layer):
    """Return the four terms of one layer as docs/reference/toponet.md states them, one number at a time."""
    found, positives = prediction.elements, 0
    classes = boxes = apart = edges = 0.0
    for b in range(BATCH):
        real = np.flatnonzero(elements.valid[b])
        box, logits = np.asarray(found.box[b, layer], np.float64), np.asarray(found.logits[b, layer], np.float64)
        cost = np.zeros((FOUND, len(real)))
        for q in range(FOUND):
            for j, e in enumerate(real):
                logit = logits[q, elements.attribute[b, e]]
                p, truth = 1 / (1 + np.exp(-logit)), elements.box[b, e]
                cost[q, j] = -np.log(p) * 0.25 * (1 - p) ** 2 + np.log(1 - p) * 0.75 * p**2
                cost[q, j] += 2.5 * np.abs(fractions(box[q], SIZES[b]) - fractions(truth, SIZES[b])).sum()
                cost[q, j] -= overlap(box[q], truth)
        owner = {q: real[j] for j, q in assign(cost).items()}
        positives += len(owner)
        for q in range(FOUND):
            for k in range(13):
                classes += focal(logits[q, k], q in owner and elements.attribute[b, owner[q]] == k)
            if q in owner:
                truth = elements.box[b, owner[q]]
                boxes += np.abs(fractions(box[q], SIZES[b]) - fractions(truth, SIZES[b])).sum()
                apart += 1 - overlap(box[q], truth)
        one = jax.tree.map(lambda leaf, b=b: leaf[b], (prediction.centerlines, lanes))
        visible = np.flatnonzero(lanes.valid[b])
        lane_cost = np.asarray(matching_cost(*one, TopoNetLossConfig()))[layer][:, visible]
        lane_of = {q: visible[j] for j, q in assign(lane_cost).items()}
        relation = np.asarray(found.lane_logits[b, layer - LAYERS], np.float64)
        for q in range(QUERIES):
            for r in range(FOUND):
                joined = q in lane_of and r in owner and elements.lane[b, lane_of[q], owner[r]]
                edges += focal(relation[q, r], joined)
    many = max(positives, 1)
    return classes / many, 2.5 * boxes / many, apart / many, 5.0 * edges / (BATCH * QUERIES * FOUND)


@pytest.mark.parametrize("counts", [(2, 3, 0), (1, 1, 1), (0, 0, 0)])
def test_terms_match_plain_loops(counts):
    prediction, lanes, elements = make_elements(1, counts, related=LAYERS)
    (total, report), _ = value_and_gradient(prediction, lanes, elements, SIZES, TopoNetLossConfig())
    layers = [loop_terms(prediction, lanes, elements, layer) for layer in range(LAYERS)]
    for name, expected in zip(("class", "box", "iou", "lane"), layers[-1], strict=True):
        assert float(report[f"element_{name}"]) == pytest.approx(expected, rel=1e-4, abs=1e-6), name
    alone = value_and_gradient(prediction.replace(elements=None), lanes, None, None, TopoNetLossConfig())[0][0]
    assert float(total - alone) == pytest.approx(np.sum(layers), rel=1e-4)
    assert float(report["matching/elements"]) == pytest.approx(np.mean(counts))


def test_topology_of_the_last_layer_alone():
    prediction, lanes, elements = make_elements(2, (2, 3, 1), related=1)
    (_, report), gradient = value_and_gradient(prediction, lanes, elements, SIZES, TopoNetLossConfig())
    assert float(report["element_lane"]) == pytest.approx(loop_terms(prediction, lanes, elements, 1)[3], rel=1e-4)
    assert gradient.elements.lane_logits.shape == (BATCH, 1, QUERIES, FOUND)
    whole, _, _ = make_elements(2, (2, 3, 1), related=LAYERS)
    (_, all_layers), _ = value_and_gradient(whole, lanes, elements, SIZES, TopoNetLossConfig())
    assert float(all_layers["successor"]) == pytest.approx(float(report["successor"]), rel=1e-6)


def test_padding_changes_nothing():
    prediction, lanes, elements = make_elements(3, (2, 0, 1), related=LAYERS)
    hole = ~elements.valid
    dirty = elements.replace(
        box=np.where(hole[..., None, None], np.nan, elements.box),
        attribute=np.where(hole, -7, elements.attribute).astype(np.int32),
        lane=elements.lane | hole[:, None, :] | ~lanes.valid[:, :, None],
    )
    clean, soiled = (value_and_gradient(prediction, lanes, e, SIZES, TopoNetLossConfig()) for e in (elements, dirty))
    jax.tree.map(np.testing.assert_array_equal, clean, soiled)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(clean))


def test_order_of_queries_lanes_and_elements_is_free():
    prediction, lanes, elements = make_elements(6, (2, 3, 1), related=LAYERS)
    found, boxes = prediction.centerlines, prediction.elements
    query, lane = np.roll(np.arange(QUERIES), 3), np.roll(np.arange(lanes.valid.shape[1]), 1)
    box, element = np.roll(np.arange(FOUND), 2), np.roll(np.arange(ELEMENTS), 1)
    other = Prediction(
        centerlines=found.replace(
            points=found.points[:, :, query],
            logits=found.logits[:, :, query],
            successor_logits=found.successor_logits[:, :, query][..., query],
        ),
        elements=boxes.replace(
            box=boxes.box[:, :, box],
            logits=boxes.logits[:, :, box],
            lane_logits=boxes.lane_logits[:, :, query][..., box],
        ),
    )
    graph = jax.tree.map(lambda leaf: leaf[:, lane], lanes)
    graph = graph.replace(successor=graph.successor[..., lane])
    signs = jax.tree.map(lambda leaf: leaf[:, element], elements.replace(lane=elements.lane.swapaxes(1, 2)[..., lane]))
    signs = signs.replace(lane=signs.lane.swapaxes(1, 2))
    (whole, terms), gradient = value_and_gradient(prediction, lanes, elements, SIZES, TopoNetLossConfig())
    (moved, others), turned = value_and_gradient(other, graph, signs, SIZES, TopoNetLossConfig())
    np.testing.assert_allclose(moved, whole, rtol=1e-5)
    for name, value in terms.items():
        np.testing.assert_allclose(others[name], value, rtol=1e-5, err_msg=name)
    for part, order in (("centerlines", query), ("elements", box)):
        own, same = getattr(gradient, part).logits[:, :, order], getattr(turned, part).logits
        np.testing.assert_allclose(same, own, rtol=1e-4, atol=1e-6)


def test_frames_without_elements_have_no_loss_of_elements_where_that_is_skipped():
    """As in the published training; their lanes still learn that no element governs them."""
    prediction, lanes, elements = make_elements(1, (2, 0, 1), related=LAYERS)
    skip = TopoNetLossConfig(elements=ElementLossConfig(empty_frames="skip"))
    (_, keep), gradient = value_and_gradient(prediction, lanes, elements, SIZES, TopoNetLossConfig())
    (_, report), skipped = value_and_gradient(prediction, lanes, elements, SIZES, skip)
    assert np.any(gradient.elements.logits[1])
    assert not np.any(skipped.elements.logits[1])
    for frame in (0, 2):
        np.testing.assert_allclose(skipped.elements.logits[frame], gradient.elements.logits[frame], rtol=1e-6)
    assert float(report["element_class"]) < float(keep["element_class"])
    for name in ("element_box", "element_iou", "element_lane", "class"):
        np.testing.assert_array_equal(report[name], keep[name])


def test_the_count_of_skipped_frames_is_at_least_that_of_frames():
    """The published mean over devices of one frame each, at least 1, is taken before empty frames are left out."""
    prediction, lanes, elements = make_elements(1, (1, 0, 0), related=LAYERS)
    skip = TopoNetLossConfig(elements=ElementLossConfig(empty_frames="skip"))
    (_, keep), _ = value_and_gradient(prediction, lanes, elements, SIZES, TopoNetLossConfig())
    (_, report), _ = value_and_gradient(prediction, lanes, elements, SIZES, skip)
    for name in ("element_box", "element_iou"):  # one matched element, three frames
        np.testing.assert_allclose(report[name], keep[name] / 3.0, rtol=1e-6)


def test_no_room_for_elements_equals_no_elements():
    prediction, lanes, elements = make_elements(1, (0, 0, 0), related=LAYERS)
    none = jax.tree.map(lambda leaf: leaf[:, :0], elements.replace(lane=elements.lane.swapaxes(1, 2)))
    none = none.replace(lane=none.lane.swapaxes(1, 2))
    expected, found = (value_and_gradient(prediction, lanes, e, SIZES, TopoNetLossConfig()) for e in (elements, none))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9), found, expected)


def test_control_points_are_compared_if_configured():
    prediction, lanes, _ = make_elements(4, (0, 0, 0), related=LAYERS)
    one = jax.tree.map(lambda leaf: leaf[0], (prediction.centerlines, lanes))
    config = TopoNetLossConfig(class_weight=0.0, points_weight=1.0)
    cost = matching_cost(*one, config, control_points=3)
    fit = bezier_fit(one[1].points.shape[1], 3)
    expected = np.abs(fit @ np.asarray(one[0].points[1, 2]) - fit @ one[1].points[4]).sum()
    assert float(cost[1, 2, 4]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("shift", [0.0, 5.0, 30.0])
def test_overlap_of_boxes(shift):
    a = np.array([[2.0, 3.0], [12.0, 9.0]], np.float32)
    b = a + np.float32(shift)
    assert float(generalised_iou(a, b)) == pytest.approx(overlap(a, b), abs=1e-5)
    assert float(generalised_iou(a, a)) == pytest.approx(1.0, abs=1e-6)
    empty = np.zeros((2, 2), np.float32)
    assert np.isfinite(jax.grad(lambda x: generalised_iou(x, empty))(empty)).all()


def test_missing_truth_is_an_error():
    prediction, lanes, _ = make_elements(5, (1, 1, 1), related=LAYERS)
    with pytest.raises(ValueError, match="needs the true ones"):
        jax.eval_shape(lambda p, t: lane_graph_loss(p, t, TopoNetLossConfig()), prediction, lanes)
