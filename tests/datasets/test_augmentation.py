"""Augmentation of road images: LSTR's recipe, geometry, colours, padding."""

import math
from dataclasses import replace

import cv2
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.shared import assert_same
from tflane_jax.datasets import augmentation
from tflane_jax.datasets.augmentation import (
    GREY,
    AugmentationConfig,
    augment,
    colour_map,
    draw_warp,
    warp_example,
    warp_lines,
)
from tflane_jax.files.images import resize
from tflane_jax.scene import LaneLines, RoadImage

HEIGHT, WIDTH = 90, 160
ALWAYS = AugmentationConfig(geometry=1.0)
NO_AUGMENTATION = AugmentationConfig(geometry=0.0, brightness=0.0, contrast=0.0, saturation=0.0, lighting=0.0)
GEOMETRY = replace(NO_AUGMENTATION, geometry=1.0)
FLIP = replace(GEOMETRY, rotation=0.0, flip=1.0, crop=1.0)
COLOUR = replace(ALWAYS, geometry=0.0)
WARPS = AugmentationConfig(geometry=1.0, brightness=0.0, contrast=0.0, saturation=0.0, lighting=0.0)


def example(seed=0, lines=4, height=HEIGHT, width=WIDTH):
    """A noisy picture with slanted lines from left to right, some points and one line absent."""
    rng = np.random.default_rng(seed)
    v = np.linspace(0.3, 0.95, 12)
    u = np.linspace(0.3, 0.7, lines)[:, None] + (v - 0.3) * np.linspace(-0.3, 0.3, lines)[:, None]
    points = np.stack([u, np.broadcast_to(v, u.shape)], -1).astype(np.float32)
    point_valid = np.ones((lines, 12), bool)
    point_valid[:1, :3] = False
    valid = np.ones(lines, bool)
    valid[3:] = False
    point_valid &= valid[:, None]
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    return RoadImage(image, np.ones((height, width), bool), LaneLines(points, point_valid, valid))


def test_the_defaults_are_lstrs_recipe():
    assert AugmentationConfig() == AugmentationConfig(10 / 11, math.radians(10), 0.5, 0.9, 0.4, 0.4, 0.4, 0.1)


@pytest.mark.parametrize("config", [NO_AUGMENTATION, replace(GEOMETRY, rotation=0.0, flip=0.0, crop=1.0)])
def test_without_augmentation_no_bit_changes(config):
    before = example()
    for seed in range(5):
        assert_same(augment(before, config, seed), before)


def test_the_same_seed_gives_the_same_bits_and_others_differ():
    before = example()
    kept = jax.tree.map(np.copy, before)
    first = augment(before, ALWAYS, (3, 1, 7))
    first.validate()
    assert [leaf.dtype for leaf in jax.tree.leaves(first)] == [leaf.dtype for leaf in jax.tree.leaves(before)]
    assert_same(augment(before, ALWAYS, (3, 1, 7)), first)
    assert_same(before, kept)
    for seed in ((3, 1, 8), (3, 2, 7), (4, 1, 7), 3):
        other = augment(before, ALWAYS, seed)
        assert (other.image != first.image).any()
        assert (other.lines.points != first.lines.points).any()


def test_colour_does_not_depend_on_geometry_being_drawn():
    """Colour and geometry have separate random streams."""
    before = example()
    warped = augment(before, WARPS, 5)
    np.testing.assert_array_equal(augment(warped, COLOUR, 5).image, augment(before, ALWAYS, 5).image)


def test_the_draws_cover_their_ranges():
    warps = [draw_warp(AugmentationConfig(), np.random.default_rng(seed), HEIGHT, WIDTH) for seed in range(2000)]
    drawn = np.array([warp for warp in warps if warp is not None])
    assert len(drawn) / 2000 == pytest.approx(10 / 11, abs=0.02)
    flipped = np.linalg.det(drawn) < 0
    assert flipped.mean() == pytest.approx(0.5, abs=0.04)
    np.testing.assert_allclose(np.abs(np.linalg.det(drawn)), 1 / 0.81)
    angles = np.degrees(np.arcsin(drawn[:, 1, 0] * 0.9))
    assert np.abs(angles).max() <= 10
    assert np.abs(angles).max() > 9.9
    assert abs(angles.mean()) < 0.5
    # Where the middle of the image goes: up to 5 % of its size to either side, and enlarged.
    middle = (drawn @ [WIDTH / 2, HEIGHT / 2, 1.0])[:, :2] / (WIDTH, HEIGHT) - 0.5
    assert np.abs(middle).max() <= 0.05 / 0.9 + 1e-9
    assert (np.abs(middle).max(0) > 0.054).all()


def test_the_draws_of_colours_cover_their_ranges(monkeypatch):
    """Each factor within its own setting of 1, in any order; lighting along the components by their deviations."""
    drawn, original = [], augmentation.colour_map
    monkeypatch.setattr(augmentation, "colour_map", lambda *args: drawn.append(args[:3]) or original(*args))
    config = replace(COLOUR, brightness=0.1, contrast=0.2, saturation=0.4, lighting=0.3)
    for seed in range(2000):
        augment(example(height=4, width=4), config, seed)
    factors, orders, light = (np.array(each) for each in zip(*drawn, strict=True))
    strength = (factors - 1.0) / [0.1, 0.2, 0.4]
    assert np.abs(strength).max() <= 1.0 + 1e-9
    np.testing.assert_allclose([strength.min(0), strength.max(0)], [[-1.0] * 3, [1.0] * 3], atol=0.01)
    np.testing.assert_allclose(strength.mean(0), 0.0, atol=0.05)
    assert len(np.unique(orders, axis=0)) == 6
    along = light @ augmentation.PCA_VECTORS
    np.testing.assert_allclose(along.std(0), 0.3 * augmentation.PCA_VALUES, rtol=0.06)


def test_a_flip_mirrors_image_and_lines():
    before = example()
    after = augment(before, FLIP, 0)
    np.testing.assert_array_equal(after.image, before.image[:, ::-1])
    assert after.image_valid.all()
    mirrored = before.lines.points[:3][::-1] * [-1, 1] + [1, 0]
    valid = before.lines.point_valid[:3][::-1]
    np.testing.assert_array_equal(after.lines.point_valid[:3], valid)
    np.testing.assert_allclose(after.lines.points[:3][valid], mirrored[valid], atol=1e-7)


def test_two_flips_are_none():
    before = example()
    after = augment(augment(before, FLIP, 0), FLIP, 1)
    np.testing.assert_array_equal(after.image, before.image)
    np.testing.assert_array_equal(after.lines.valid, before.lines.valid)
    np.testing.assert_array_equal(after.lines.point_valid, before.lines.point_valid)
    valid = before.lines.point_valid
    np.testing.assert_allclose(after.lines.points[valid], before.lines.points[valid], atol=1e-6)


@pytest.mark.parametrize(("seed", "larger"), [(seed, 1 + seed % 2) for seed in range(12)])
def test_points_stay_on_the_painted_line(seed, larger):
    """Painted lines are bright under their points after the warp, in the middle of the paint; half of them larger."""
    before = example(lines=3, height=360 * larger, width=640 * larger)
    image = np.zeros_like(before.image)
    # OpenCV paints around pixel centres, half a pixel from the corner that shares count from; 1/16 pixel steps.
    for points in before.lines.points:
        pixels = np.round((points * (640 * larger, 360 * larger) - 0.5) * 16).astype(np.int32)
        cv2.polylines(image, [pixels], False, (255, 255, 255), 3 * larger, cv2.LINE_AA, 4)
    after = augment(replace(before, image=image), WARPS, seed, (360, 640))
    points = after.lines.points[after.lines.point_valid] * (640, 360) - 0.5
    points = points[((points > 6) & (points < (633, 353))).all(1)].astype(np.float32)
    assert len(points) > 12
    across = np.stack([np.arange(-5, 5.5, 0.5), np.zeros(21)], -1).astype(np.float32)
    profile = cv2.remap(after.image, points[:, None] + across, None, cv2.INTER_LINEAR)[..., 0].astype(float)
    assert profile[:, 10].min() > 150
    center = (profile * across[:, 0]).sum(1) / profile.sum(1)
    assert abs(np.median(center)) < 0.15
    assert np.abs(center).max() < 1.0


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.floats(0.0, 1.5), st.floats(0.4, 1.0))
def test_warped_lines_keep_the_vocabularys_promises(seed, rotation, crop):
    after = augment(example(seed), replace(GEOMETRY, rotation=rotation, crop=crop), seed)
    lines = after.lines
    assert not (lines.point_valid & ~lines.valid[:, None]).any()
    count = lines.point_valid.sum(1)
    np.testing.assert_array_equal(count >= 2, lines.valid)
    firsts = []
    for points, valid in zip(lines.points[lines.valid], lines.point_valid[lines.valid], strict=True):
        assert ((points[valid] >= 0) & (points[valid] <= 1)).all()
        assert (np.diff(points[valid, 1]) >= 0).all()
        firsts.append(points[valid, 0][0])
    assert firsts == sorted(firsts)
    assert np.argsort(~lines.valid, kind="stable").tolist() == list(range(len(count)))  # valid ones first


def test_steep_turns_swap_points_of_one_line():
    """A half turn: rows ascend again, each point at its own place."""
    lines = example().lines
    half = np.array([[-1.0, 0.0, WIDTH], [0.0, -1.0, HEIGHT], [0.0, 0.0, 1.0]])
    turned = warp_lines(lines, half, HEIGHT, WIDTH)
    expected = {tuple(np.round(1 - p, 5)) for p in lines.points[lines.point_valid]}
    assert {tuple(np.round(p, 5)) for p in turned.points[turned.point_valid]} == expected
    for points, valid in zip(turned.points, turned.point_valid, strict=True):
        assert (np.diff(points[valid, 1]) > 0).all()


def test_of_lines_that_a_turn_bends_back_the_near_part_stays():
    """Points on an arc after a hook: turned by 45 degrees, its far end has rows that its near end has, too."""
    angles = np.radians(np.linspace(90.0, 0.0, 11))  # from the far end, where the arc is level, to the near one
    arc = np.insert(np.stack([0.3 + 0.2 * np.cos(angles), 0.6 - 0.2 * np.sin(angles)], -1), 0, (0.4, 0.39), 0)
    points, valid = np.pad(arc, ((1, 1), (0, 0)))[None].astype(np.float32), np.arange(14)[None] % 13 > 0
    cos = math.sqrt(0.5)
    turn = np.array([[cos, cos, 0.0], [-cos, cos, 0.3 * HEIGHT], [0.0, 0.0, 1.0]])
    after = warp_lines(LaneLines(points, valid, np.array([True])), turn, HEIGHT, HEIGHT)
    near = (arc @ turn[:2, :2].T + [0.0, 0.3])[-6:]  # the rows ascend from the middle to the near end
    assert near[:, 1].argmin() == 0
    np.testing.assert_allclose(after.points[0][after.point_valid[0]], near, atol=1e-6)


def test_lines_that_leave_the_image_are_dropped():
    lines = example().lines
    shift = np.array([[1.0, 0.0, -0.4 * WIDTH], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    after = warp_lines(lines, shift, HEIGHT, WIDTH)
    np.testing.assert_array_equal(after.valid, [True, True, False, False])
    # Line 0 is left of 0.4, line 1 from its sixth point on, line 2 right of it.
    np.testing.assert_array_equal(after.point_valid.sum(1), [6, 12, 0, 0])
    # A line labelled by one point only is kept as long as that point is.
    point_valid = np.zeros_like(lines.point_valid)
    point_valid[:3, 5] = True
    single = warp_lines(replace(lines, point_valid=point_valid), shift, HEIGHT, WIDTH)
    np.testing.assert_array_equal(single.point_valid.sum(1), [1, 1, 0, 0])


def test_pixels_without_an_image_are_black_and_not_valid():
    before = replace(example(), image=np.full((HEIGHT, WIDTH, 3), 200, np.uint8))
    turn = replace(ALWAYS, rotation=math.radians(30), crop=1.0)
    after = augment(before, turn, 1)
    outside = ~after.image_valid
    assert 0.02 < outside.mean() < 0.5
    assert after.image[outside].max() == 0
    eroded = cv2.erode(after.image_valid.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    assert len(np.unique(after.image[eroded].reshape(-1, 3), axis=0)) == 1


@pytest.mark.parametrize("config", [ALWAYS, WARPS, COLOUR], ids=["all", "geometry", "colour"])
def test_padding_changes_nothing(config):
    before = example()
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, 120:] = mask[:20] = False
    lines = before.lines
    black = np.where(mask[..., None], before.image, 0).astype(np.uint8)
    garbage = np.where(mask[..., None], before.image, 255 - before.image).astype(np.uint8)
    points = np.where(lines.point_valid[..., None], lines.points, np.float32(np.nan))
    # A line that is not valid has no points, whatever its `point_valid` says.
    marked = lines.point_valid | ~lines.valid[:, None]
    for seed in range(6):
        clean = augment(RoadImage(black, mask, lines), config, seed)
        dirty = augment(RoadImage(garbage, mask, LaneLines(points, marked, lines.valid)), config, seed)
        np.testing.assert_array_equal(dirty.image, clean.image)
        np.testing.assert_array_equal(dirty.image_valid, clean.image_valid)
        if config is not COLOUR:  # which leaves the labels alone, padding and all
            assert_same(dirty.lines, clean.lines)


@pytest.mark.parametrize(("lines", "points"), [(0, 12), (1, 0), (1, 1), (0, 0)])
def test_sizes_0_and_1(lines, points):
    before = replace(example(), lines=LaneLines.empty(lines, points))
    before.lines.point_valid[:] = True
    before.lines.valid[:] = True
    before.lines.points[:] = 0.5
    after = augment(before, ALWAYS, 0)
    after.validate()
    assert after.lines.valid.sum() == min(lines, points)


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
def test_one_colour_map_is_the_steps_in_their_order(order):
    """Against brightness, contrast, saturation and lighting one after the other on float colours."""
    rng = np.random.default_rng(1)
    image = rng.uniform(size=(5, 7, 3))
    factors, light = rng.uniform(0.6, 1.4, 3), rng.normal(size=3) * 0.05
    grey = image @ GREY
    expected = image
    for kind in order:
        blend = (np.zeros(()), grey.mean(), grey[..., None])[kind]
        expected = factors[kind] * expected + (1 - factors[kind]) * blend
    expected = expected + light
    colour = colour_map(factors, order, light, float(grey.mean()))
    np.testing.assert_allclose(image @ colour[:, :3].T + colour[:, 3], expected, atol=1e-12)


def test_colours_are_mapped_rounded_and_clipped(monkeypatch):
    before = example()
    seen = {}
    original = augmentation.colour_map
    monkeypatch.setattr(augmentation, "colour_map", lambda *args: seen.setdefault("map", original(*args)).copy())
    after = augment(before, replace(COLOUR, lighting=1.0), 2)
    colour = seen["map"]
    exact = (before.image / 255.0) @ colour[:, :3].T + colour[:, 3]
    assert (exact < 0).any() or (exact > 1).any()
    # OpenCV computes in fixed point: less than one level, not half a level, from the exact value.
    np.testing.assert_allclose(after.image, np.clip(exact, 0, 1) * 255, rtol=0, atol=0.99)


@pytest.mark.parametrize("seed", range(3))
def test_contrast_is_about_the_mean_grey_of_what_the_image_shows(seed):
    """Padding, which is black, does not count: half an image beside padding changes as by itself."""
    whole, half = example(), WIDTH // 2
    valid = np.broadcast_to(np.arange(WIDTH) < half, whole.image_valid.shape)
    contrast = replace(NO_AUGMENTATION, contrast=0.4)
    padded = augment(replace(whole, image_valid=valid), contrast, seed)
    alone = replace(whole, image=whole.image[:, :half], image_valid=np.ones_like(valid[:, :half]))
    np.testing.assert_array_equal(padded.image[:, :half], augment(alone, contrast, seed).image)
    assert (padded.image != whole.image)[:, :half].any()


def test_lighting_reads_red_green_and_blue():
    """The components are orthonormal; the first, by far the largest, is grey with slightly more blue than red."""
    vectors = augmentation.PCA_VECTORS
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=1e-6)
    assert abs(vectors[2, 0]) > abs(vectors[1, 0]) > abs(vectors[0, 0]) > 0.5


def test_shared_read_only_masks_are_fine():
    before = example()
    shared = replace(before, image_valid=np.broadcast_to(True, (HEIGHT, WIDTH)))
    assert_same(augment(shared, ALWAYS, 4), augment(before, ALWAYS, 4))
    assert_same(warp_example(shared, np.eye(3), (HEIGHT, WIDTH)).image, before.image)


# ---------------------------------------------------------------------------------------------------------------------
# Another size


def test_the_examples_own_size_changes_no_bit():
    before = example()
    for seed in range(5):
        assert_same(augment(before, ALWAYS, seed, (HEIGHT, WIDTH)), augment(before, ALWAYS, seed))


def test_a_change_of_size_alone_is_the_usual_one():
    before = example(height=2 * HEIGHT, width=2 * WIDTH)
    after = augment(before, NO_AUGMENTATION, 0, (HEIGHT, WIDTH))
    usual = resize(before.image, HEIGHT, WIDTH)
    assert np.abs(after.image.astype(int) - usual).max() <= 1
    assert after.image_valid.shape == (HEIGHT, WIDTH)
    assert after.image_valid.all()
    jax.tree.map(np.testing.assert_array_equal, after.lines, before.lines)


def test_full_frames_are_cropped_before_they_are_resized():
    """As in LSTR's program; resizing first would interpolate twice."""
    config, size = replace(GEOMETRY, rotation=0.0, flip=0.0), (HEIGHT, WIDTH)
    before = example(height=2 * HEIGHT, width=2 * WIDTH)
    sharpness = lambda image: cv2.Laplacian(image, cv2.CV_64F).var()  # noqa: E731
    for seed in range(4):
        after = augment(before, config, seed, size)
        first = augment(
            replace(before, image=resize(before.image, *size), image_valid=np.ones(size, bool)), config, seed
        )
        np.testing.assert_allclose(after.lines.points, first.lines.points, atol=1e-6)
        assert sharpness(after.image) > 1.3 * sharpness(first.image)
        (geometry,) = np.random.default_rng(seed).spawn(1)
        warp = draw_warp(config, geometry, 2 * HEIGHT, 2 * WIDTH)
        left, top = -warp[:2, 2] * config.crop
        crop = round(config.crop * 2 * HEIGHT), round(config.crop * 2 * WIDTH)
        x, y = round(left), round(top)
        published = resize(before.image[y : y + crop[0], x : x + crop[1]], *size)
        # Whole pixels of the crop there, fractions here.
        assert sharpness(after.image) == pytest.approx(sharpness(published), rel=0.4)
