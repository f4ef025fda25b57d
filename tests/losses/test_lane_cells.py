"""BEV cells through which lanes pass, and the auxiliary loss on them."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.slow import with_slow
from tflane_jax.geometry import PerceptionRange
from tflane_jax.losses import lane_cells as losses
from tflane_jax.losses.auxiliary import auxiliary_losses
from tflane_jax.losses.lane_cells import lane_cell_loss, used_lanes
from tflane_jax.losses.lane_weights import LaneWeights
from tflane_jax.models.auxiliary import CELL_CHANNELS, AuxiliaryOutputs
from tflane_jax.scene import LaneGraph

RANGE = PerceptionRange((0.0, 8.0), (0.0, 4.0), (-1.0, 1.0))
SHAPE = (4, 8)  # cells of one metre
lane_cells = jax.jit(losses.lane_cells, static_argnums=(1, 2))


def graph(*lines, capacity=3, garbage=np.nan):
    lanes = LaneGraph.empty(capacity, len(lines[0]) if lines else 2)
    lanes.points[:] = garbage
    for i, line in enumerate(lines):
        lanes.points[i] = line
        lanes.valid[i] = True
    return lanes


def test_a_lane_fills_the_cells_that_it_runs_through():
    cells = lane_cells(graph([[0.2, 1.5, 0], [3.8, 1.5, 0]]), SHAPE, RANGE)
    expected = np.zeros(SHAPE, bool)
    expected[1, :4] = True
    np.testing.assert_array_equal(cells.inside, expected)
    np.testing.assert_allclose(cells.direction[expected], [[1.0, 0.0]] * 4, atol=1e-6)


def test_cells_beside_a_lane_hold_the_offset_to_it():
    cells = lane_cells(graph([[0.0, 1.75, 0], [8.0, 1.75, 0]]), SHAPE, RANGE)
    np.testing.assert_array_equal(cells.near, [[True] * 8] * 3 + [[False] * 8])
    np.testing.assert_allclose(cells.offset[:3, :, 1], np.repeat([[1.25], [0.25], [-0.75]], 8, 1), atol=1e-6)
    np.testing.assert_allclose(cells.offset[..., 0], 0.0, atol=1e-6)
    np.testing.assert_array_equal(cells.offset[3], 0.0)
    np.testing.assert_array_equal(cells.direction[3], 0.0)


def test_offsets_are_in_cells_and_directions_in_metres():
    wide = PerceptionRange((0.0, 16.0), (0.0, 4.0), (-1.0, 1.0))  # cells of 2 m x 1 m
    cells = lane_cells(graph([[0.0, 0.0, 0], [4.0, 4.0, 0]]), SHAPE, wide)
    np.testing.assert_allclose(cells.direction[1, 0], np.sqrt([0.5, 0.5]), atol=1e-6)
    # In cells the lane goes from (0, 0) to (2, 4), and passes (0.5, 1.5) at (0.7, 1.4).
    np.testing.assert_allclose(cells.offset[1, 0], [0.2, -0.1], atol=1e-6)


def test_the_nearer_of_two_lanes_counts_and_lanes_outside_fill_no_cell():
    cells = lane_cells(
        graph([[0.0, 0.5, 0], [8.0, 0.5, 0]], [[8.0, 3.0, 0], [0.0, 3.0, 0]], [[0.0, 4.5, 0], [-3.0, -1.0, 0]]),
        SHAPE,
        RANGE,
    )
    np.testing.assert_allclose(cells.direction[:2, 2:, 0], 1.0, atol=1e-6)
    np.testing.assert_allclose(cells.direction[2:, 2:, 0], -1.0, atol=1e-6)
    np.testing.assert_array_equal(cells.inside[0], True)
    np.testing.assert_array_equal(cells.inside[1], False)


@pytest.mark.parametrize("twice", range(3))
def test_a_repeated_point_changes_nothing(twice):
    """Regression: cells nearest to a first point that is there twice learned the direction (0, 0)."""
    line = [[2.3, 1.5, 0], [4.1, 1.6, 0], [6.6, 2.9, 0]]
    doubled = [*line[: twice + 1], *line[twice:]]
    for found, expected in zip(
        lane_cells(graph(doubled), SHAPE, RANGE), lane_cells(graph(line), SHAPE, RANGE), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_a_lane_of_a_single_place_fills_no_cell():
    line, other = [[0.0, 0.5, 0], [8.0, 0.5, 0]], [[4.5, 2.5, 0], [4.5, 2.5, 0]]
    for found, expected in zip(
        lane_cells(graph(line, other), SHAPE, RANGE), lane_cells(graph(line), SHAPE, RANGE), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_padding_changes_nothing():
    line = [[0.0, 0.5, 0], [8.0, 3.5, 0]]
    said = jax.random.normal(jax.random.key(0), (*SHAPE, CELL_CHANNELS))
    gradient = jax.grad(lane_cell_loss)
    clean, dirty = (gradient(said, graph(line, garbage=garbage), RANGE) for garbage in (0.0, np.nan))
    np.testing.assert_array_equal(clean, dirty)
    assert np.isfinite(clean).all()


@pytest.mark.parametrize("lanes", [graph(), graph(capacity=0)], ids=["none valid", "no room"])
def test_a_scene_without_lanes_has_a_gradient(lanes):
    said = jnp.zeros((*SHAPE, CELL_CHANNELS))
    assert lane_cell_loss(said, lanes, RANGE) == pytest.approx(0.5 * np.log(2.0))
    assert (jax.grad(lane_cell_loss)(said, lanes, RANGE)[..., 0] > 0).all()


def test_the_truth_has_the_least_loss():
    lanes = graph([[0.0, 0.5, 0], [8.0, 3.5, 0]])
    cells = lane_cells(lanes, SHAPE, RANGE)
    perfect = jnp.concatenate([jnp.where(cells.inside, 20.0, -20.0)[..., None], cells.offset, cells.direction], -1)
    assert lane_cell_loss(perfect, lanes, RANGE) < 1e-6
    assert lane_cell_loss(perfect.at[..., 0].multiply(-1), lanes, RANGE) > 10.0


@pytest.mark.parametrize("valid", with_slow([(), (0, 2), (0, 1, 2), (1, 3)], quick=[(), (1, 3)]))
def test_padding_after_the_last_valid_lane_of_a_batch_is_not_looked_at(valid):
    """All numbers are bit by bit those of a loop over every lane; the lanes that are left out may hold anything."""
    rng = np.random.default_rng(len(valid))
    points = rng.uniform(0.0, 4.0, (2, 5, 4, 3)).astype(np.float32) * np.float32([2.0, 1.0, 0.0])
    mask = np.zeros((2, 5), bool)
    mask[1, list(valid)] = mask[0, list(valid[:1])] = True
    blank = graph(capacity=5)
    lanes = [
        jax.tree.map(jnp.asarray, replace(blank, points=np.where(there[:, None, None], of, np.nan), valid=there))
        for of, there in zip(points, mask, strict=True)
    ]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lanes)
    used = used_lanes(batch.valid)
    assert used == max(valid, default=-1) + 1
    said = jnp.asarray(rng.normal(size=(2, *SHAPE, CELL_CHANNELS)).astype(np.float32))
    loss = jax.value_and_grad(lambda *each: jax.vmap(lane_cell_loss, (0, 0, None, None))(*each).sum())
    whole, short = (jax.jit(loss, static_argnums=2)(said, batch, RANGE, count) for count in (5, used))
    jax.tree.map(np.testing.assert_array_equal, whole, short)


@pytest.mark.slow
def test_a_batch_of_few_lanes_takes_few_rounds(monkeypatch):
    """Regression: the loop went over the padding, too."""
    rounds = []
    loop = SimpleNamespace(fori_loop=lambda lower, upper, body, start: (rounds.append(int(upper) - lower), start)[1])
    monkeypatch.setattr(losses, "lax", loop)
    one, none = graph([[0.0, 0.5, 0], [4.0, 2.0, 0], [8.0, 3.5, 0]], capacity=50), LaneGraph.empty(50, 3)
    batch = jax.tree.map(lambda *leaves: jnp.stack(list(map(jnp.asarray, leaves))), none, one)
    outputs = AuxiliaryOutputs(lane_cells=jnp.zeros((2, *SHAPE, CELL_CHANNELS)))
    settings = {"weights": LaneWeights(), "bev_range": RANGE, "denoising": None}
    auxiliary_losses(outputs, ("lane_cells",), batch, **settings)
    assert rounds == [2]
