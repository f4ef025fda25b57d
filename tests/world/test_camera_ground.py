"""The ground in camera images: texture, paint, wear, kerbs."""

import numpy as np
import pytest

from tests.world.camera_scene import X, Y, street
from tflane_jax.world.cameras.ground import draw_ground, sample_ground
from tflane_jax.world.cameras.ground_window import Window, window_around
from tflane_jax.world.cameras.paint import paint_of
from tflane_jax.world.roads.area import road_rings

pytest.importorskip("cv2")

STREET = street()
MIDDLE = np.array([[X, Y]])


def ground(window, wear=0.5, levels=6):
    paint = paint_of(np.random.default_rng(1), STREET, paint_wear=wear, log_seed=3)
    return draw_ground(np.random.default_rng(2), STREET, paint, window, dirt=0.4, wet=0.0, urban=True, levels=levels)


def test_ground_stays_where_it_is_in_every_window():
    """Two overlapping windows have the same texels in their overlap, with texture, dirt and wear."""
    first, second = (ground(window_around(MIDDLE + shift, 12.0, 0.08), levels=1) for shift in ([0.0, 0.0], [7.3, 3.9]))
    column, row = np.round((np.array(second.window.low) - first.window.low) / 0.08).astype(int)
    a, b = first.levels[0][row:, column:], second.levels[0][: first.window.rows - row, : first.window.columns - column]
    assert min(a.shape[:2]) > 150
    inner = (slice(4, -4), slice(4, -4))
    # Lines that a border cuts may differ by a rounding along it.
    assert (a[inner] != b[inner]).any(-1).mean() < 2e-3


def test_every_texel_of_a_line_is_as_wide_as_its_paint():
    """Across a fresh line lies paint of about 13 cm, however coarse the texels are."""
    widths = []
    for texel in (0.02, 0.05, 0.08):
        drawn = ground(window_around(MIDDLE - [30.0, 0.0], 6.0, texel), wear=0.0, levels=1)
        row = round((Y - drawn.window.low[1]) / texel)
        span = round(0.5 / texel)
        strip = drawn.levels[0][row - span : row + span, 20:-20].astype(float).max(-1).mean(1)
        asphalt, paint = np.median(strip), 0.86 * 255.0
        widths.append((strip - asphalt).clip(0.0).sum() * texel / (paint - asphalt))
    np.testing.assert_allclose(widths, 0.13, atol=0.06)


def test_worn_paint_is_fainter_and_gone_where_nothing_is_left():
    window = window_around(MIDDLE - [30.0, 0.0], 6.0, 0.05)
    row = round((Y - window.low[1]) / 0.05)
    brightness = [ground(window, wear, 1).levels[0][row - 1 : row + 1].astype(float).mean() for wear in (0.0, 0.5, 1.0)]
    assert brightness[0] > brightness[1] + 8.0 > brightness[2] + 16.0


def test_sampling_averages_what_a_pixel_covers():
    """A pixel as large as the window's stripes sees their mean, a small one sees the stripe."""
    drawn = ground(Window((X, Y), 0.1, 64, 64))
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 200
    levels = [stripes]
    for _ in range(3):
        levels.append(levels[-1].reshape(len(levels[-1]) // 2, 2, -1, 2, 3).mean((1, 3)).astype(np.uint8))
    striped = type(drawn)(drawn.window, tuple(levels))
    x = np.float32([[3.05, 3.15, 3.25]])
    y = np.full_like(x, 3.05)
    fine = sample_ground(striped, x, y, np.float32([0.1]), np.float32([0.1]))
    np.testing.assert_allclose(fine[0, :, 0], [200.0, 0.0, 200.0], atol=1.0)
    coarse = sample_ground(striped, x, y, np.float32([0.8]), np.float32([0.8]))
    np.testing.assert_allclose(coarse[0, :, 0], 100.0, atol=2.0)


def test_the_road_lies_between_its_kerbs():
    """Kerbs that end at the border of the map are joined across the street's ends; islands stay rings of their own."""
    south = np.array([(0.0, -4.0, 0.0), (50.0, -4.0, 0.0)])
    north = np.array([(50.0, 4.0, 0.0), (0.0, 4.0, 0.0)])
    island = np.array([(10.0, -1.0, 0.0), (20.0, -1.0, 0.0), (20.0, 1.0, 0.0), (10.0, 1.0, 0.0), (10.0, -1.0, 0.0)])
    rings = road_rings([south, island, north])
    assert sorted(len(ring) for ring in rings) == [4, 5]
    outline = max(rings, key=lambda ring: np.ptp(ring[:, 0]))
    x, y = outline.T
    area = 0.5 * abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    assert area == pytest.approx(400.0)
    beside = np.array([0.0, 30.0, 0.0])
    assert len(road_rings([south, south + beside, north + beside, north])) == 2
