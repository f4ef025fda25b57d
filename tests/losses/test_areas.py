"""The loss of areas with a decoder of their own: rings, classes, padding, sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.slow import with_slow
from tflane_jax.losses.areas import AreaLossConfig, area_loss, area_targets
from tflane_jax.scene import AreaPrediction, Areas, AreaType

POINTS = 6
RING = np.array([[0, 0], [4, 0], [5, 2], [3, 4], [0, 3], [0, 0]], np.float32)


def make_areas(garbage=0.0, shift=0):
    """Return a crossing, whose ring starts `shift` points later, an open boundary, and padding."""
    areas = Areas.empty(3, POINTS)
    ring = np.roll(RING[:-1], -shift, 0)
    areas.points[0, :, :2] = np.concatenate([ring, ring[:1]])
    areas.points[1] = np.linspace([-9.0, 6.0, 0.0], [9.0, 6.0, 1.0], POINTS)
    areas.points[2] = garbage
    areas.category[:] = AreaType.PEDESTRIAN_CROSSING, AreaType.ROAD_BOUNDARY, 0
    areas.valid[:2] = True
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], areas)


def make_prediction(seed=0):
    rng = np.random.default_rng(seed)
    points, logits = 5.0 * rng.normal(size=(1, 2, 4, POINTS, 3)), rng.normal(size=(1, 2, 4, 2))
    return AreaPrediction(jnp.asarray(points, jnp.float32), jnp.asarray(logits, jnp.float32))


def perfect_prediction(areas, shift=0.0):
    """Return two equal layers: the two areas, moved along x, two queries far away, and classes at 0.5."""
    points = areas.points[:, :2].at[..., 0].add(shift)
    points = jnp.concatenate([points, jnp.full((1, 2, POINTS, 3), 40.0)], 1)
    return AreaPrediction(jnp.stack([points, points], 1), jnp.zeros((1, 2, 4, 2)))


def loss(areas, prediction=None, **settings):
    run = jax.jit(lambda p, a: area_loss(p, a, AreaLossConfig(**settings), "jax"))
    return run(make_prediction() if prediction is None else prediction, areas)


@pytest.mark.parametrize("shift", with_slow([1, 3], quick=[3]))
def test_where_a_ring_starts_does_not_matter(shift):
    (whole, terms), (moved, others) = loss(make_areas()), loss(make_areas(shift=shift))
    np.testing.assert_allclose(moved, whole, rtol=1e-5)
    for name, value in terms.items():
        np.testing.assert_allclose(others[name], value, rtol=1e-5, err_msg=name)


def test_a_boundary_may_be_drawn_from_either_end():
    areas = make_areas()
    turned = areas.replace(points=areas.points.at[0, 1].set(areas.points[0, 1, ::-1]))
    np.testing.assert_allclose(loss(turned)[0], loss(areas)[0], rtol=1e-5)


def test_padding_may_hold_anything_and_no_area_is_no_target():
    clean, dirty = loss(make_areas()), loss(make_areas(np.nan))
    np.testing.assert_array_equal(clean[0], dirty[0])
    nothing = make_areas().replace(valid=jnp.zeros((1, 3), bool))
    value, report = loss(nothing)
    assert float(report["matching/areas"]) == 0.0
    assert float(report["area_points"]) == 0.0
    assert np.isfinite(value)
    none = jax.tree.map(lambda leaf: leaf[:, :0], make_areas())
    np.testing.assert_allclose(loss(none)[0], value, rtol=1e-6)


def test_order_of_queries_and_areas_is_free():
    query, area, prediction = np.array([2, 0, 3, 1]), np.array([2, 1, 0]), make_prediction()
    other = jax.tree.map(lambda leaf: leaf[:, :, query], prediction)
    moved, others = loss(jax.tree.map(lambda leaf: leaf[:, area], make_areas()), other)
    whole, terms = loss(make_areas(), prediction)
    np.testing.assert_allclose(moved, whole, rtol=1e-5)
    for name, value in terms.items():
        np.testing.assert_allclose(others[name], value, rtol=1e-5, err_msg=name)


def test_terms_by_hand():
    """Perfect points and directions; classes at 0.5: 2 layers, 2 matched of 4 queries with 2 classes."""
    areas = make_areas()
    value, report = loss(areas, perfect_prediction(areas))
    assert float(report["area_points"]) == 0.0
    # Steps of no length, and none of these lines has one, would count 1.
    np.testing.assert_allclose(report["area_direction"], 0.0, atol=1e-6)
    each = np.log(2) / 4
    classes = 1.5 * (2 * 0.25 * each + 6 * 0.75 * each) / 2
    np.testing.assert_allclose(report["area_class"], classes, rtol=1e-5)
    np.testing.assert_allclose(value, 2 * classes, rtol=1e-5)
    # Six points, each 1 m off; the L1 of the published loss is in metres.
    shifted = perfect_prediction(areas, 1.0)
    np.testing.assert_allclose(loss(areas, shifted)[1]["area_points"], 0.025 * 6.0, rtol=1e-4)


def test_the_class_may_be_the_quality_of_the_points():
    """Points 1 m off have a quality of 1 / (1 + 1), which matched queries predict: only the six other classes count."""
    areas = make_areas()
    _, report = loss(areas, perfect_prediction(areas, 1.0), class_target="quality")
    np.testing.assert_allclose(report["area_class"], 1.5 * 6 * 0.25 * np.log(2) / 2, rtol=1e-4)


def test_short_steps_count_less_in_directions():
    """True steps have a cosine of L^2 / (L^2 + least^2) with themselves."""
    areas = make_areas()
    squared = (np.diff(np.asarray(areas.points[0, :2], float), axis=1) ** 2).sum(-1)
    _, report = loss(areas, perfect_prediction(areas), least_step=3.0)
    expected = 0.005 * (1.0 - squared / (squared + 9.0)).sum() / 2
    np.testing.assert_allclose(report["area_direction"], expected, rtol=1e-4)


@pytest.mark.parametrize("rings", ["one", "both"])
def test_a_ring_may_turn_either_way_only_where_the_setting_says_so(rings):
    areas = make_areas()
    turned = areas.replace(points=areas.points.at[0, 0].set(areas.points[0, 0, ::-1]))
    _, report = loss(turned, perfect_prediction(areas), rings=rings)
    assert (float(report["area_points"]) < 1e-6) == (rings == "both")
    assert area_targets(jax.tree.map(lambda leaf: leaf[0], areas), rings).order_valid.sum(-1).tolist() == (
        [10, 2, 10] if rings == "both" else [5, 2, 5]
    )


def test_classes_are_those_of_areas():
    targets = area_targets(jax.tree.map(lambda leaf: leaf[0], make_areas()))
    assert targets.category.tolist() == [0, 1, 0]
    assert targets.order_valid.sum(-1).tolist() == [5, 2, 5]
    assert targets.valid.tolist() == [True, True, False]
