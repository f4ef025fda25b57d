"""Photometric augmentation changes colours and nothing else."""

import colorsys
from dataclasses import replace

import numpy as np
import pytest

from tests.fakes import fake_example, fake_views
from tflane_jax.datasets.photometric import PhotometricConfig, augment_example, augment_views, distort, draw_grid

NOTHING = PhotometricConfig(probability=0.0, swap=0.0)
ALWAYS = replace(NOTHING, probability=1.0, brightness=0.0, contrast=(1.0, 1.0), saturation=(1.0, 1.0), hue=0.0)
IMAGE = np.random.default_rng(0).integers(60, 180, (12, 9, 3), np.uint8)


def distorted(config, seed=0, image=IMAGE):
    return distort(image, config, np.random.default_rng(seed)).astype(float)


def test_the_seed_alone_decides():
    views, config = fake_views(), PhotometricConfig(grid_mask=0.7)
    first, again, other = (augment_views(views, config, seed).image for seed in ((1, 2, 3), (1, 2, 3), (1, 2, 4)))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_views_change_on_their_own_and_nothing_else_changes():
    views = fake_views()
    views.image[:, 40:] = 7  # padding may hold anything
    views.valid[2] = False
    after = augment_views(views, PhotometricConfig(grid_mask=1.0), 3)
    changed = (after.image != views.image).any((1, 2, 3))
    assert changed.sum() >= 4
    assert not changed[2]
    for i, (width, height) in enumerate(views.size):
        np.testing.assert_array_equal(after.image[i, height:], views.image[i, height:])
        np.testing.assert_array_equal(after.image[i, :, width:], views.image[i, :, width:])
    alone = views.replace(valid=np.arange(6) == 1)
    np.testing.assert_array_equal(
        augment_views(alone, PhotometricConfig(), 3).image[1], augment_views(views, PhotometricConfig(), 3).image[1]
    )
    assert after.intrinsics is views.intrinsics


def test_zero_strength_changes_nothing():
    np.testing.assert_array_equal(distorted(NOTHING), IMAGE)
    np.testing.assert_allclose(distorted(ALWAYS), IMAGE, atol=1)  # to hue and back


def test_brightness_adds_and_contrast_multiplies():
    added = np.stack([distorted(replace(ALWAYS, brightness=32.0), seed) - IMAGE for seed in range(40)])
    assert np.ptp(added, (1, 2, 3)).max() <= 2
    shifts = added.mean((1, 2, 3))
    assert -33 < shifts.min() < -20
    assert 20 < shifts.max() < 33
    factors = np.stack([distorted(replace(ALWAYS, contrast=(0.5, 1.4)), seed) / IMAGE for seed in range(40)])
    assert factors.std((1, 2, 3)).max() < 0.02
    means = factors.mean((1, 2, 3))
    assert 0.49 < means.min() < 0.65
    assert 1.25 < means.max() < 1.41


@pytest.mark.parametrize("colour", [(180, 120, 90), (90, 60, 180), (180, 90, 95), (200, 90, 80)])
def test_saturation_and_hue_are_those_of_hsv(colour):
    """The last two colours lie on either side of the wrap-around of hue."""
    row = np.full((1, 100, 3), colour, np.uint8)  # OpenCV has other code for long rows than for short ones
    hue, saturation, value = colorsys.rgb_to_hsv(*row[0, 0] / 255)
    less = distorted(replace(ALWAYS, saturation=(0.5, 0.5)), image=row)[0, 0] / 255
    np.testing.assert_allclose(colorsys.rgb_to_hsv(*less), (hue, saturation / 2, value), atol=0.01)
    images = [distorted(replace(ALWAYS, hue=18.0), seed, row) for seed in range(30)]
    assert all((image == image[0, 0]).all() for image in images)
    turned = [image[0, 0] / 255 for image in images]
    hues = [(360 * (colorsys.rgb_to_hsv(*colour)[0] - hue) + 180) % 360 - 180 for colour in turned]
    assert -19 < min(hues) < -10
    assert 10 < max(hues) < 19
    np.testing.assert_allclose(
        [colorsys.rgb_to_hsv(*colour)[1:] for colour in turned], [(saturation, value)] * 30, atol=0.01
    )


def test_channels_are_swapped():
    swaps = {
        tuple(np.argsort(distorted(replace(NOTHING, swap=1.0), seed, np.array([[[10, 20, 30]]], np.uint8))[0, 0]))
        for seed in range(40)
    }
    assert len(swaps) == 6


@pytest.mark.parametrize("seed", range(5))
def test_a_grid_hides_squares_of_the_mean_colour(seed):
    config = replace(NOTHING, grid_mask=1.0)
    grid = draw_grid(config, np.random.default_rng(seed), 60, 80)
    rows, columns = grid.any(1), grid.any(0)
    np.testing.assert_array_equal(grid, rows[:, None] & columns)
    image = augment_views(fake_views(), config, seed).image[0]
    hidden = (image == [124, 116, 104]).all(-1)
    assert 0 < hidden[:32, :48].mean() < 1
    assert draw_grid(NOTHING, np.random.default_rng(seed), 60, 80) is None


def test_all_views_have_the_same_grid():
    views = fake_views().replace(image=np.full_like(fake_views().image, 200))
    image = augment_views(views, replace(NOTHING, grid_mask=1.0), 0).image
    hidden = (image == [124, 116, 104]).all(-1)
    assert hidden[0].any()
    for view, (width, height) in zip(hidden, views.size, strict=True):
        np.testing.assert_array_equal(view[:height, :width], hidden[0, :height, :width])
        assert not view[height:].any()  # padding keeps its content
        assert not view[:, width:].any()


@pytest.mark.parametrize("seed", range(8))
def test_a_grid_has_one_period_and_hides_half_of_it(seed):
    grid = draw_grid(replace(NOTHING, grid_mask=1.0), np.random.default_rng(seed), 400, 400)
    for axis in (0, 1):
        edges = np.flatnonzero(np.diff(grid.any(axis).astype(int)))
        widths = np.diff(edges)
        assert (abs(widths[:-1:2] - widths[1::2]) <= 1).all()
        assert len(set(widths[::2].tolist())) <= 1


@pytest.mark.parametrize("seed", range(20))
def test_a_grid_has_as_many_stripes_as_fit_into_the_larger_canvas(seed):
    """Regression: stripes went on for ever, and hid 25 instead of 27 percent of the pixels."""
    height, width = 60, 90
    grid = draw_grid(replace(NOTHING, grid_mask=1.0), np.random.default_rng(seed), height, width)
    _, period, *starts = np.random.default_rng(seed).uniform(size=4)
    period = 2 + int(period * (height - 2))
    kept = min(max(int(period / 2 + 0.5), 1), period - 1)
    hidden = []
    for size, start in zip((height, width), starts, strict=True):
        whole = int(1.5 * size)
        line = np.ones(whole, bool)
        for stripe in range(whole // period):
            first = period * stripe + int(start * period)
            line[first : first + kept] = False
        hidden.append(line[(whole - size) // 2 :][:size])
    np.testing.assert_array_equal(grid, hidden[0][:, None] & hidden[1])


def test_a_grid_is_drawn_with_its_probability():
    config = PhotometricConfig(grid_mask=0.7)
    drawn = [draw_grid(config, np.random.default_rng(seed), 50, 50) for seed in range(300)]
    assert 0.62 < np.mean([grid is not None for grid in drawn]) < 0.78
    fractions = [grid.mean() for grid in drawn if grid is not None]
    assert 0.15 < np.mean(fractions) < 0.35  # half of the rows and half of the columns


def test_an_example_without_cameras_stays_as_it_is():
    assert augment_example(fake_example(), PhotometricConfig(), 0).cameras is None
    example = fake_example().replace(cameras=fake_views())
    assert (augment_example(example, PhotometricConfig(), 1).cameras.image != example.cameras.image).any()
