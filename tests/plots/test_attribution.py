"""Pictures of attribution: bands, numbered tracks, bars, curves."""

import numpy as np
import pytest

from tests.fakes import fake_example
from tflane_jax.plots import style
from tflane_jax.plots.attribution import FAINT, draw_bars, draw_lane_bands, draw_removal, draw_road_users
from tflane_jax.plots.bev import prepare
from tflane_jax.plots.figure import new_figure

to_rgba = pytest.importorskip("matplotlib.colors").to_rgba


@pytest.fixture
def ax():
    ax = new_figure()[1][0, 0]
    prepare(ax)
    return ax


def test_a_band_is_as_wide_as_a_lane(ax):
    lane = np.array([[[0.0, 1.0, 0.0], [5.0, 1.0, 0.0], [5.0, 1.0, 0.0], [9.0, 1.0, 0.0]]])  # a point twice
    draw_lane_bands(ax, lane)
    (band,) = ax.collections[0].get_paths()
    assert np.isfinite(band.vertices).all()
    np.testing.assert_allclose([band.vertices[:, 1].min(), band.vertices[:, 1].max()], [-0.3, 2.3])


def test_no_lanes_give_no_bands(ax):
    draw_lane_bands(ax, np.zeros((0, 4, 3)))
    assert ax.collections[0].get_paths() == []


def test_tracks_are_numbered_and_as_strong_as_their_weights(ax):
    example = fake_example(padding=np.nan)
    draw_road_users(ax, example.traffic_flow, np.array([1, 0]), np.array([0.2, 0.0]))
    first, second = (ax.collections[i] for i in (0, 2))
    np.testing.assert_allclose(first.get_segments()[0], example.traffic_flow.position[1, 2:, :2], rtol=1e-6)
    assert (first.get_colors()[0, 3], second.get_colors()[0, 3]) == pytest.approx((1.0, FAINT))
    assert [text.get_text() for text in ax.texts] == ["0", "1"]
    np.testing.assert_allclose(ax.texts[0].xy, example.traffic_flow.position[1, -1, :2], rtol=1e-6)


def test_an_absent_road_user_has_no_track(ax):
    example = fake_example()
    draw_road_users(ax, example.traffic_flow, np.array([0]), np.array([0.5]), absent=[0])
    cross, box = ax.collections
    assert [len(line) for line in cross.get_segments()] == [2, 2]
    assert box.get_facecolors()[0, 3] == 0.0
    np.testing.assert_allclose(cross.get_colors()[0], to_rgba(style.OTHER_ELEMENT))


def test_a_road_user_out_of_view_is_labelled_on_its_track(ax):
    example = fake_example()
    flow = example.traffic_flow
    flow.position[0, 2:, 0], flow.position[0, 2:, 1] = [0.0, 20.0, 45.0, 80.0], 3.0  # the view ends at 50 m
    flow.position[1, 2:, :2] = [44.0, 3.0]
    draw_road_users(ax, flow, np.array([0, 1]), np.ones(2))
    assert [text.xy for text in ax.texts] == [pytest.approx((0.0, 3.0)), pytest.approx((44.0, 3.0))]
    flow.position[0, 2:, 0] = 90.0
    ax.texts[0].remove()
    ax.texts[0].remove()
    draw_road_users(ax, flow, np.array([0]), np.ones(1))
    assert len(ax.texts) == 0


def test_a_track_without_a_valid_frame_is_left_out(ax):
    flow = fake_example().traffic_flow
    flow.valid[0] = False
    draw_road_users(ax, flow, np.array([0, 1]), np.ones(2))
    assert len(ax.collections) == 2
    assert [text.get_text() for text in ax.texts] == ["1"]


def test_numbers_do_not_cover_the_title(ax):
    flow = fake_example().traffic_flow
    low, high = ax.get_ylim()
    flow.position[0, 2:, :2], flow.position[1, 2:, :2] = [0.0, high - 2.0], [10.0, 0.5 * (low + high)]
    draw_road_users(ax, flow, np.array([0, 1]), np.ones(2))
    assert [text.xyann[1] for text in ax.texts] == [-11, 11]


@pytest.mark.parametrize("count", [0, 1, 3])
def test_bars_start_at_the_top(ax, count):
    values = np.arange(count) / 10
    draw_bars(ax, values, title="t", label="l", highlighted=[1], reference=0.2)
    assert [patch.get_width() for patch in ax.patches] == pytest.approx(values)
    assert ax.yaxis_inverted()
    pink = [patch.get_facecolor() == to_rgba(style.LINK) for patch in ax.patches]
    assert pink == [i == 1 for i in range(count)]


def test_curves_have_their_names(ax):
    draw_removal(ax, {"a": np.array([0.5, 0.1]), "b": np.array([0.5])}, title="t")
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["a", "b"]
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [[0, 0.5], [1, 0.1]])


@pytest.mark.filterwarnings("error")
def test_no_curves_have_no_legend(ax):
    draw_removal(ax, {}, title="t")
    assert ax.get_legend() is None
