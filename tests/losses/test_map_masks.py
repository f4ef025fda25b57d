"""Masks of map lines in BEV and in images against OpenCV and exact geometry; depth bins."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from tests.fakes import fake_views
from tflane_jax.errors import UserError
from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.cameras import project
from tflane_jax.losses import map_masks
from tflane_jax.losses.map_masks import depth_targets
from tflane_jax.scene import MapLines, stack_examples

RANGE = PerceptionRange((-30.0, 30.0), (-15.0, 15.0))
SHAPE = (50, 100)
bev_line_mask = jax.jit(map_masks.bev_line_mask, static_argnums=(1, 2))
view_line_masks = jax.jit(map_masks.view_line_masks, static_argnums=2)


def lines(*rows, padding=np.nan):
    points = len(rows[0]) if rows else 3
    made = MapLines.empty(len(rows) + 1, points)
    made.points[:] = padding
    for i, row in enumerate(rows):
        made.points[i] = np.column_stack([np.asarray(row, float), np.zeros(points)])[:, :3]
    made.valid[: len(rows)] = True
    return made


def cells(mask):
    return sorted(map(tuple, np.argwhere(np.asarray(mask)).tolist()))


def test_a_straight_line_covers_five_rows():
    mask = bev_line_mask(lines([(-29.9, 0.1), (0, 0.1), (29.9, 0.1)]), SHAPE, RANGE)
    assert cells(mask) == [(row, column) for row in range(23, 28) for column in range(100)]
    across = bev_line_mask(lines([(0.1, -14.9), (0.1, 0), (0.1, 14.9)]), SHAPE, RANGE)
    assert cells(across) == [(row, column) for row in range(50) for column in range(48, 53)]


@pytest.mark.parametrize("seed", range(5))
def test_masks_agree_with_opencv(seed):
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(seed)
    size = np.array([100, 50])
    curves = np.cumsum(rng.uniform(-3, 3, (4, 12, 2)), 1) + rng.uniform(-10, 10, (4, 1, 2))
    corners = np.floor(RANGE.normalise(curves) * size)
    mask = np.asarray(bev_line_mask(lines(*RANGE.denormalise((corners + 0.5) / size)), SHAPE, RANGE))
    thick = np.zeros(SHAPE, np.uint8)
    for curve in corners.astype(np.int32):
        cv2.polylines(thick, [curve], False, 1, 3)
    thick = thick > 0
    assert (mask & thick).sum() / (mask | thick).sum() > 0.92
    assert maximum_filter(mask, 3)[thick].all()


def test_lines_are_cut_at_the_border_or_run_along_it_and_padding_draws_nothing():
    outside = lines([(-90, 0.1), (0, 0.1), (90, 0.1)], [(40, 20), (50, 20), (60, 20)])
    inside = lines([(-29.9, 0.1), (0, 0.1), (29.9, 0.1)])
    np.testing.assert_array_equal(bev_line_mask(outside, SHAPE, RANGE), bev_line_mask(inside, SHAPE, RANGE))
    assert not bev_line_mask(lines(), SHAPE, RANGE).any()
    for row, edge in ((slice(0, 3), -15), (slice(47, 50), 15)):
        mask = np.asarray(bev_line_mask(lines([(-30, edge), (0, edge), (30, edge)]), SHAPE, RANGE))
        assert mask[row].all()
        assert mask.sum() == 300
    for column, edge in ((slice(0, 3), -30), (slice(97, 100), 30)):
        mask = np.asarray(bev_line_mask(lines([(edge, -15), (edge, 0), (edge, 15)]), SHAPE, RANGE))
        assert mask[:, column].all()
        assert mask.sum() == 150
    still = np.asarray(bev_line_mask(lines([(3.1, 3.1), (3.1, 3.1), (3.1, 3.1)]), SHAPE, RANGE))
    disc = np.add.outer(np.arange(-2, 3) ** 2, np.arange(-2, 3) ** 2) <= 4
    np.testing.assert_array_equal(still[28:33, 53:58], disc)
    assert still.sum() == 13


def test_lines_are_drawn_at_their_dense_points_where_labels_have_them():
    """The points that a model learns cut the corner of a right angle."""
    corner = [(3, -6), (3, 6), (15, 6)]
    ends, true = lines([corner[0], corner[2]]), lines(corner)
    both, views = dataclasses.replace(ends, dense=true.points), fake_views()
    for draw in (lambda of: bev_line_mask(of, SHAPE, RANGE), lambda of: view_line_masks(of, views, (12, 16))):
        np.testing.assert_array_equal(draw(both), draw(true))
        assert (np.asarray(draw(both)) != draw(ends)).any()


def test_images_show_the_cells_that_projected_lines_cross():
    views, shape = fake_views(), (12, 16)
    height, width = views.image.shape[1:3]
    ahead = [(-20.0, -1.5), (3.0, 1.0), (25.0, 2.0)]
    masks = np.asarray(view_line_masks(lines(ahead), views, shape))
    assert masks.shape == (6, *shape)
    dense = np.concatenate([np.linspace(a, b, 4000) for a, b in itertools.pairwise(ahead)])
    dense = np.column_stack([dense, np.zeros(len(dense))])
    for number in range(6):
        pixels, depth, _ = project(dense, *(np.asarray(x)[number] for x in (views.intrinsics, views.camera_from_ego)))
        cell = np.floor(pixels[depth > 0.1] * [shape[1] / width, shape[0] / height]).astype(int)
        cell = cell[((cell >= 0) & (cell < [shape[1], shape[0]])).all(-1)]
        expected = np.zeros(shape, bool)
        expected[cell[:, 1], cell[:, 0]] = True
        # Every cell drawn is crossed; a corner that is barely crossed may be left out.
        assert expected[masks[number]].all()
        assert maximum_filter(masks[number], 3)[expected].all()
        assert masks[number].sum() >= 0.6 * expected.sum()
    assert masks[0].any()
    assert not masks[3].all()


def test_cameras_without_an_image_have_no_lines():
    views = dataclasses.replace(fake_views(), valid=np.zeros(6, bool))
    assert not view_line_masks(lines([(2, 0), (9, 0), (20, 0)]), views, (12, 16)).any()


def test_no_room_for_lines_shows_none():
    none = MapLines.empty(0, 5)
    assert not bev_line_mask(none, SHAPE, RANGE).any()
    assert not view_line_masks(none, fake_views(), (12, 16)).any()


def test_masks_are_made_under_jit_and_vmap():
    batch = stack_examples([lines([(0, 0), (5, 5), (9, 0)]), lines([(1, 0), (5, 1), (9, 9)])])
    together = jax.jit(jax.vmap(lambda one: bev_line_mask(one, SHAPE, RANGE)))(batch)
    for number in range(2):
        one = jax.tree.map(lambda leaf, i=number: leaf[i], batch)
        np.testing.assert_array_equal(together[number], bev_line_mask(one, SHAPE, RANGE))


def with_depth(depth, valid=True):
    depth = np.broadcast_to(np.asarray(depth, np.float32), (6, 4, 8)).copy()
    return dataclasses.replace(fake_views(), depth=depth, depth_valid=np.broadcast_to(np.asarray(valid), depth.shape))


@pytest.mark.parametrize(
    ("depth", "expected"), [(0.99, None), (1.0, 0), (1.49, 0), (1.5, 1), (34.9, 67), (35.0, None), (90.0, None)]
)
def test_bins_of_depth(depth, expected):
    bins, valid = depth_targets(with_depth(depth), (4, 8))
    assert np.asarray(valid).all() == (expected is not None)
    assert expected is None or (np.asarray(bins) == expected).all()
    # MapTRv2: floor((d - (1 - 0.5)) / 0.5), kept between 1 and 68.
    published = np.floor((np.float32(depth) - 0.5) / 0.5)
    assert (1 <= published <= 68) == (expected is not None)
    assert expected is None or published - 1 == expected


def test_a_depth_just_below_the_last_border_is_in_the_last_bin():
    """(62.2 - 1) / 0.9 is 68 bins, and rounds up to 68 in float32."""
    bins, valid = depth_targets(with_depth(np.nextafter(np.float32(62.2), np.float32(0))), (4, 8), high=62.2, step=0.9)
    assert np.asarray(valid).all()
    assert (np.asarray(bins) == 67).all()


def test_the_nearest_measured_surface_of_a_cell_counts():
    depth, valid = np.full((6, 4, 8), 20.0), np.ones((6, 4, 8), bool)
    depth[0, 0, 0], depth[0, 1, 1] = 3.0, 2.0
    valid[0, 1, 1] = False
    bins, kept = depth_targets(with_depth(depth, valid), (2, 4))
    assert (int(bins[0, 0, 0]), int(bins[0, 0, 1])) == (4, 38)
    assert kept.all()
    assert not depth_targets(with_depth(depth, False), (2, 4))[1].any()


def test_depth_that_is_missing_or_does_not_fit_is_named():
    with pytest.raises(UserError, match="depth_cell"):
        depth_targets(fake_views(), (2, 4))
    with pytest.raises(UserError, match="4 x 8 cells does not fit features of 3 x 8"):
        depth_targets(with_depth(3.0), (3, 8))
