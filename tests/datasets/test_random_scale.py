"""Scaled images: what a camera sees stays where it was, and arrays keep their size."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.fakes import fake_example, fake_views
from tflane_jax.datasets.photometric import PhotometricConfig, augment_example
from tflane_jax.datasets.random_scale import scaled_example
from tflane_jax.geometry.cameras import project

SCALED = PhotometricConfig(probability=0.0, swap=0.0, scale=(0.5, 0.9))


def with_views(**changes):
    """Return an example with images, and a light whose box is around a point of the front image."""
    example, views = fake_example(), fake_views().replace(**changes)
    example.traffic_elements.box[0] = [[10.0, 6.0], [20.0, 14.0]]
    return example.replace(cameras=views)


@pytest.mark.parametrize("factor", [0.5, 0.75, 0.9])
def test_points_are_seen_at_the_same_place_of_smaller_images(factor):
    before, after = with_views().cameras, scaled_example(with_views(), factor).cameras
    assert after.image.shape == before.image.shape
    assert after.intrinsics.dtype == before.intrinsics.dtype
    points = np.random.default_rng(0).uniform([5, -3, 0], [30, 3, 3], (20, 3))
    for number, (old, new) in enumerate(zip(before.size, after.size, strict=True)):
        np.testing.assert_array_equal(new, np.round(old * factor))
        pixels = [project(points, each.intrinsics[number], each.camera_from_ego[number])[0] for each in (before, after)]
        np.testing.assert_allclose(pixels[0] / old, pixels[1] / new, atol=1e-4)
        # The images are smooth, so the colour of a place stays.
        for u, v in ((0.3, 0.4), (0.7, 0.6)):
            colours = [
                each.image[number, int(v * h), int(u * w)].astype(float)
                for each, (w, h) in ((before, old), (after, new))
            ]
            np.testing.assert_allclose(colours[0], colours[1], atol=8)
        assert not after.image[number, new[1] :].any()
        assert not after.image[number, :, new[0] :].any()


def test_boxes_follow_the_front_image():
    box = scaled_example(with_views(), 0.5).traffic_elements.box
    np.testing.assert_allclose(box[0], [[5.0, 3.0], [10.0, 7.0]])
    dark = with_views(valid=np.arange(6) > 0)
    np.testing.assert_array_equal(scaled_example(dark, 0.5).traffic_elements.box, dark.traffic_elements.box)


def test_invalid_cameras_and_padding_may_hold_anything():
    clean, dirty = with_views(valid=np.arange(6) != 2), with_views(valid=np.arange(6) != 2)
    for array in (dirty.cameras.image[2], dirty.cameras.image[:, 40:]):
        array[:] = 99
    dirty.cameras.intrinsics[2], dirty.cameras.size[2] = np.nan, 0
    clean, dirty = (scaled_example(each, 0.7).cameras for each in (clean, dirty))
    used = np.arange(6) != 2
    for name in ("image", "size", "intrinsics"):
        np.testing.assert_array_equal(getattr(clean, name)[used], getattr(dirty, name)[used])


def test_depth_stays_with_its_surface():
    depth = np.zeros((6, 6, 8), np.float32)
    depth[:, 3:5, 5:8] = 10.0  # the middles of the new cells lie in rows 1, 3, 5 and columns 1, 3, 5, 7
    views = {"depth": depth, "depth_valid": depth > 0}
    after = scaled_example(with_views(**views), 0.5).cameras
    expected = np.zeros((6, 6, 8), bool)
    expected[:, 1:2, 2:4] = True
    np.testing.assert_array_equal(after.depth_valid, expected)
    np.testing.assert_array_equal(after.depth, np.where(expected, np.float32(10.0), 0.0))


def test_nothing_changes_without_cameras_or_at_full_size():
    blind, seeing = fake_example(), with_views()
    assert scaled_example(blind, 0.5) is blind
    assert scaled_example(seeing, 1.0) is seeing


def test_augmentation_draws_one_factor_for_all_views_of_a_frame():
    factors = []
    for seed in range(30):
        after = augment_example(with_views(), SCALED, (1, 2, seed))
        jax.tree.map(np.testing.assert_array_equal, after, augment_example(with_views(), SCALED, (1, 2, seed)))
        factors.append(after.cameras.size[0, 0] / 48)
        # Both sides are rounded to whole pixels.
        np.testing.assert_allclose(after.cameras.size, factors[-1] * with_views().cameras.size, atol=0.84)
    assert 0.49 < min(factors) < 0.6
    assert 0.8 < max(factors) < 0.91


def test_the_scale_does_not_change_the_colours_that_are_drawn():
    """A setting changes its own effect alone."""
    flat = with_views(image=np.full_like(fake_views().image, 120))
    colours = replace(SCALED, probability=1.0)
    plain = augment_example(flat, replace(colours, scale=(1.0, 1.0)), 5).cameras.image[:, 0, 0]
    np.testing.assert_array_equal(augment_example(flat, colours, 5).cameras.image[:, 0, 0], plain)
    assert (plain != 120).any()
