"""Denoising queries: noise, the lane of each query, and no effect on predictions."""

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import BASELINE, make_example
from tests.parameters import random_params
from tflane_jax.geometry import PerceptionRange
from tflane_jax.losses.toponet import TopoNetLossConfig, lane_denoising_losses
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.bevformer_detr import BevFormerDetrConfig
from tflane_jax.models.lane_denoising import DenoisingConfig, decode_groups, noised_lanes
from tflane_jax.scene import CenterlinePrediction, LaneGraph, MapLines, Prediction, stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

RANGE = PerceptionRange()
QUIET = DenoisingConfig(2, shift=0.0, turn=0.0, stretch=0.0, straighten=0.0)
KEY = jax.random.key(3)
noised = jax.jit(noised_lanes, static_argnums=(2, 3, 4))
denoising_losses = jax.jit(lane_denoising_losses, static_argnums=2)


def curve(count=3, capacity=5, garbage=np.nan):
    lanes = LaneGraph.empty(capacity, 11)
    lanes.points[:] = garbage
    along = np.linspace(0, 1, 11)
    for i in range(count):
        lanes.points[i] = np.stack([20 * along, 3 * i + 4 * along**2, 0 * along], -1)
        lanes.valid[i] = True
    return lanes


def test_without_noise_lanes_stay_and_other_queries_lie_in_the_range():
    lines = np.asarray(noised(KEY, curve(), 6, RANGE, QUIET))
    np.testing.assert_allclose(lines[:3], curve().points[:3], atol=1e-5)
    middle = lines[3:].mean(1)
    assert RANGE.contains(middle).all()
    np.testing.assert_allclose(np.linalg.norm(lines[3:, -1] - lines[3:, 0], axis=-1), 24.0, rtol=1e-4)
    assert len(np.unique(middle.round(3), axis=0)) == 3


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({"shift": 2.0}, lambda line: line - line.mean(0)),
        ({"shift": 2.0}, lambda line: line[:, 2]),
        ({"turn": 0.5}, lambda line: line[:, 2]),
        ({"turn": 0.5}, lambda line: np.linalg.norm(line[:, None] - line[None], axis=-1)),
        ({"stretch": 0.5}, lambda line: (line - line.mean(0)) / np.linalg.norm(line[-1] - line[0])),
        ({"straighten": 1.0}, lambda line: line[[0, -1]]),
    ],
)
def test_each_kind_of_noise_leaves_something_as_it_was(change, same):
    truth = curve().points[:3]
    lines = np.asarray(noised(KEY, curve(), 3, RANGE, replace(QUIET, **change)))
    assert np.abs(lines - truth).max((1, 2)).min() > 0.01
    for line, true in zip(lines, truth, strict=True):
        np.testing.assert_allclose(same(line), same(true), atol=1e-3)


def test_a_ring_keeps_its_form():
    square = np.array([[0, 0, 0], [6, 0, 0], [6, 3, 0], [0, 3, 0], [0, 0, 0]], np.float32)
    lines = MapLines.empty(3, 5)
    lines.points[:2], lines.valid[:2], lines.closed[0] = square, True, True
    ring, opened, _ = np.asarray(noised(KEY, lines, 3, RANGE, replace(QUIET, straighten=1.0)))
    np.testing.assert_allclose(ring, square, atol=1e-5)
    assert np.ptp(opened, axis=0)[0] < 5.9, "a line that only happens to end where it begins has a chord"


def test_padding_may_hold_nan_and_sizes_may_differ():
    noise = DenoisingConfig()
    clean, dirty = (noised(KEY, curve(garbage=value), 4, RANGE, noise) for value in (0.0, np.nan))
    np.testing.assert_array_equal(clean, dirty)
    for count, capacity, queries in ((0, 0, 2), (0, 3, 2), (3, 3, 1), (1, 1, 4)):
        lines = noised(KEY, curve(count, capacity), queries, RANGE, noise)
        assert lines.shape == (queries, 11, 3)
        assert np.isfinite(lines).all()


def test_a_query_belongs_to_its_own_lane():
    lanes = jax.tree.map(lambda leaf: leaf[None], curve())
    lanes.successor[0, 0, 1] = True
    truth = np.nan_to_num(lanes.points)[:, None, None, :4]  # four queries, five slots
    perfect = CenterlinePrediction(
        points=jnp.asarray(truth),
        logits=jnp.where(jnp.arange(4) < 3, 20.0, -20.0)[None, None, None, :, None],
        successor_logits=jnp.where(lanes.successor[:, None, None, :4, :4], 20.0, -20.0),
    )
    losses = denoising_losses(perfect, lanes, TopoNetLossConfig())
    assert all(float(term.sum()) < 1e-6 for term in losses.values())
    swapped = perfect.replace(points=perfect.points[:, :, :, [1, 0, 2, 3]])
    # Lanes 0 and 1 lie three metres apart, and there are three.
    points = denoising_losses(swapped, lanes, TopoNetLossConfig(points_weight=1.0))["points"]
    np.testing.assert_allclose(points, 2 * 33.0 / 3, rtol=1e-5)


class Echo(nn.Module):
    """A host whose predictions are its queries."""

    dropout: float = 0.0

    @nn.compact
    def __call__(self, start, noised):
        return decode_groups(self, start, noised, None, None, {}, True)

    def decode_queries(self, start, bev, elements, tokens, deterministic):
        points = nn.Dropout(self.dropout, deterministic=False, name="dropout")(start)
        return Prediction(centerlines=CenterlinePrediction(points, points[..., 0, :1]))


def test_learned_queries_are_predicted_and_all_copies_taught():
    start = jax.random.normal(KEY, (4, 11, 3))
    noised = start[None] + jnp.arange(1.0, 4.0)[:, None, None, None]
    found, state = Echo().apply({}, start, noised, mutable=AUXILIARY)
    np.testing.assert_array_equal(found.centerlines.points, start)
    (taught,) = state[AUXILIARY]["denoised"]
    np.testing.assert_array_equal(taught.points, noised)


def test_each_copy_drops_features_of_its_own():
    ones = jnp.ones((3, 4, 11, 3))
    found, state = Echo(0.5).apply({}, ones[0], ones[1:], mutable=AUXILIARY, rngs={"dropout": KEY})
    (taught,) = state[AUXILIARY]["denoised"]
    kept = np.concatenate([found.centerlines.points[None], taught.points]) > 0
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert 0.3 < (kept[i] == kept[j]).mean() < 0.7


HOSTS = {
    "toponet": replace(BASELINE, decoder=replace(BASELINE.decoder, layers=1)),
    "detr": BevFormerDetrConfig(
        encoder=BASELINE.encoder, decoder=replace(BASELINE.decoder, layers=1, refine="fixed"), elements=None
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTS)
def test_denoising_changes_only_the_loss(name):
    plain, noisy = (LaneGraphTask(replace(HOSTS[name], denoising=noise)) for noise in (None, DenoisingConfig()))
    params = random_params(noisy.init, make_example())
    without = {key: value for key, value in params.items() if key != "noised"}
    batch = jax.tree.map(jnp.asarray, stack_examples([make_example(0)]))
    terms = jax.jit(plain.loss)(without, batch, KEY)[1]
    gradient, more = jax.jit(jax.grad(noisy.loss, has_aux=True))(params, batch, KEY)
    for key, value in terms.items():
        np.testing.assert_allclose(more[key], value, rtol=1e-4, err_msg=key)
    assert {"denoised_class", "denoised_points", "denoised_successor"} <= more.keys()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert np.abs(gradient["noised"]["content"]).max() > 0
    step = jax.eval_shape(noisy.predict, params, make_example())
    assert jax.tree.map(lambda leaf: leaf.shape, step) == jax.tree.map(
        lambda leaf: leaf.shape, jax.eval_shape(plain.predict, without, make_example())
    )
