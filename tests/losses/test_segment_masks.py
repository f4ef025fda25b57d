"""Masks of lane segments against a loop over cells and against OpenCV."""

from functools import partial

import jax
import numpy as np
import pytest

from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.losses import segment_masks as losses

RANGE = PerceptionRange((-10.0, 10.0), (-5.0, 5.0), (-1.0, 1.0))
segment_masks = jax.jit(losses.segment_masks, static_argnames=("shape", "range_", "raster"))


def make_boundaries(seed, count, length=12.0, width=3.0):
    """Return bent segments in any direction, some partly outside the range."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(0, 2 * np.pi, count)[:, None] + np.linspace(0, 1, 6) * rng.uniform(-1, 1, (count, 1))
    middle = rng.uniform(-0.8, 0.8, (count, 1, 2)) * np.array([10.0, 5.0])
    step = length / 6 * np.stack([np.cos(heading), np.sin(heading)], -1)
    center = np.cumsum(step, 1) - step.sum(1, keepdims=True) / 2 + middle
    across = width / 2 * np.stack([-np.sin(heading), np.cos(heading)], -1)
    height = np.zeros((count, 6, 1))
    return (np.concatenate([center + sign * across, height], -1).astype(np.float32) for sign in (1, -1))


def inside(x, y, ring):
    """Return whether a point lies in a polygon, by the parity of crossed edges."""
    odd = False
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, 0), strict=True):
        if (ay > y) != (by > y) and ax + (y - ay) / (by - ay) * (bx - ax) < x:
            odd = not odd
    return odd


def test_cells_whose_center_lies_inside():
    left, right = make_boundaries(0, 12)
    grid = BevGrid(RANGE, rows=7, columns=13)
    found = np.asarray(jax.jit(lambda a, b: segment_masks(a, b, (7, 13), RANGE))(left, right))
    xs, ys = grid.centers()
    for n in range(len(left)):
        ring = np.concatenate([left[n], right[n, ::-1]])[:, :2].astype(np.float64)
        np.testing.assert_array_equal(found[n], [[inside(x, y, ring) for x in xs] for y in ys])
    assert 0.02 < found.mean() < 0.5


def test_published_raster_is_that_of_opencv():
    cv2 = pytest.importorskip("cv2")
    left, right = make_boundaries(1, 60, length=40.0, width=6.0)
    left[..., :2], right[..., :2] = left[..., :2] * 2.0, right[..., :2] * 2.0
    grid = BevGrid()  # 102.4 m x 51.2 m, 100 x 200 cells
    raster = jax.jit(partial(segment_masks, shape=(100, 200), range_=grid.range, raster="published"))
    found = np.asarray(raster(left, right))
    expected = np.zeros_like(found)
    for n in range(len(left)):
        ring = np.concatenate([left[n], right[n, ::-1], left[n, :1]])[:, :2]
        corners = (ring * [200 / 100, 100 / 50] + [100, 50]).astype(np.int32)
        image = np.zeros((100, 200), np.uint8)
        expected[n] = cv2.fillPoly(image, [corners], 1) > 0
    overlap = (found & expected).sum((1, 2)) / np.maximum((found | expected).sum((1, 2)), 1)
    assert overlap.mean() > 0.995, overlap
    assert overlap.min() > 0.97, overlap
    # The grid's own range gives other masks.
    assert not np.array_equal(found, np.asarray(segment_masks(left, right, (100, 200), grid.range)))


@pytest.mark.parametrize("motion", ["mirrored", "turned", "shifted"])
def test_masks_move_with_their_segments(motion):
    left, right = make_boundaries(2, 12)
    shape, box = (10, 20), RANGE
    mask = np.asarray(segment_masks(left, right, shape, box))
    if motion == "mirrored":
        moved = [line * np.array([1.0, -1.0, 1.0], np.float32) for line in (right, left)]
        expected = mask[:, ::-1]
    elif motion == "turned":
        moved = [np.stack([-line[..., 1], line[..., 0], line[..., 2]], -1) for line in (left, right)]
        shape, box = (20, 10), PerceptionRange(RANGE.y, RANGE.x, RANGE.z)
        expected = np.flip(mask.swapaxes(1, 2), 2)
    else:  # by three columns and one row: cells are 1 m wide
        moved = [line + np.array([3.0, 1.0, 0.0], np.float32) for line in (left, right)]
        expected = np.pad(mask[:, :-1, :-3], ((0, 0), (1, 0), (3, 0)))
    found = np.array(segment_masks(*moved, shape, box))
    if motion == "shifted":  # what comes in over the border was not on the grid before
        found[:, :1], found[:, :, :3] = False, False
    assert expected.any()
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("raster", ["cells", "published"])
@pytest.mark.parametrize("count", [0, 1])
def test_sizes_0_and_1_and_segments_without_area(raster, count):
    line = np.zeros((count, 1, 3), np.float32)
    masks = segment_masks(line, line, (3, 4), RANGE, raster)
    assert masks.shape == (count, 3, 4)
    assert masks.sum() <= (count if raster == "published" else 0)
