"""Pictures from above: lanes, evidence, tracks and predictions, without padding."""

import numpy as np
import pytest

from tests.fakes import POINTS, empty_example, fake_example, fake_prediction
from tests.plots.pictures import count_colours
from tflane_jax.plots import style
from tflane_jax.plots.bev import draw_evidence, draw_lanes, draw_prediction, draw_scene
from tflane_jax.plots.figure import new_figure
from tflane_jax.plots.lines import box_corners
from tflane_jax.plots.priors import draw_traffic
from tflane_jax.scene import CenterlinePrediction

# A submodule is an attribute of its package only once something has imported it.
agg = pytest.importorskip("matplotlib.backends.backend_agg")
collections = pytest.importorskip("matplotlib.collections")
colors = pytest.importorskip("matplotlib.colors")


def pixels(draw) -> np.ndarray:
    """Return the picture that `draw(ax)` gives, as (H, W, 4) uint8."""
    figure, axes = new_figure()
    draw(axes[0, 0])
    figure.canvas = agg.FigureCanvasAgg(figure)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())


def lines(ax) -> list:
    """Return every polyline of the axes, as (n, 2)."""
    found = [c for c in ax.collections if isinstance(c, collections.LineCollection)]
    return [segment for collection in found for segment in collection.get_segments()]


def boxes(ax) -> list:
    found = [c for c in ax.collections if isinstance(c, collections.PolyCollection)]
    return [path.vertices[:-1] for collection in found for path in collection.get_paths()]


def test_padding_never_reaches_the_picture():
    shown = [pixels(lambda ax, p=p: draw_scene(ax, fake_example(padding=p))) for p in (0.0, np.nan)]
    np.testing.assert_array_equal(*shown)
    assert count_colours(shown[0]) > 50


def test_a_scene_without_anything_is_drawn():
    draw = pixels(lambda ax: draw_scene(ax, empty_example()))
    bare = empty_example().replace(bev=None, hidden=None, traffic_flow=None, traffic_elements=None)
    assert draw.shape == pixels(lambda ax: draw_scene(ax, bare)).shape


def test_layers_choose_what_is_drawn(ax):
    draw_scene(ax, fake_example(), layers=())
    assert lines(ax) == []
    draw_scene(ax, fake_example(), layers=("lanes",))
    assert len(lines(ax)) == 2


def test_lanes_lie_where_they_are_and_show_their_visibility(ax):
    lanes = fake_example().lanes
    draw_lanes(ax, lanes)
    np.testing.assert_allclose(lines(ax), lanes.points[:2, :, :2], rtol=1e-6)
    clear, hidden = (colors.to_rgb(c) for c in (style.LANE_CLEAR, style.LANE_HIDDEN))
    colours = ax.collections[0].get_colors()
    np.testing.assert_allclose(colours[1, :3], clear, atol=0.01)
    np.testing.assert_allclose(colours[0, :3], 0.25 * np.asarray(clear) + 0.75 * np.asarray(hidden), atol=0.01)


def test_evidence_is_drawn_with_its_origin_at_the_lower_left(ax):
    bev = np.zeros((10, 20, 4), np.uint8)
    bev[0, 0, 0] = 255
    draw_evidence(ax, bev)
    image = ax.images[0]
    left, right, bottom, top = image.get_extent()
    assert left < right
    assert bottom < top
    assert image.origin == "lower"
    shown = image.get_array().sum(-1)
    assert np.unravel_index(shown.argmax(), shown.shape) == (0, 0)


def test_tracks_end_in_a_box_that_is_empty_where_it_was_not_seen(ax):
    flow = fake_example().traffic_flow
    draw_traffic(ax, flow)
    trails, (boxes_,) = ax.collections[0], ax.collections[1:]
    # Two road users seen in four frames each: three steps.
    assert len(trails.get_segments()) == 6
    ages = trails.get_colors()[:3, 3]
    assert (np.diff(ages) > 0).all()
    np.testing.assert_allclose(boxes(ax)[0].mean(0), flow.position[0, -1, :2], rtol=1e-5)
    assert boxes_.get_facecolor()[0, 3] == 0.0
    assert boxes_.get_facecolor()[1, 3] > 0.0


def test_a_gap_in_a_track_is_not_drawn_over(ax):
    flow = fake_example().traffic_flow
    flow.valid[0, 3] = False
    draw_traffic(ax, flow)
    assert len(ax.collections[0].get_segments()) == 4


def test_box_corners_turn_with_the_heading():
    corners = box_corners(np.asarray([[10.0, 5.0]]), np.asarray([np.pi / 2]), np.asarray([[4.0, 2.0]]))
    np.testing.assert_allclose(corners[0], [[9, 7], [9, 3], [11, 3], [11, 7]], atol=1e-12)


def test_confident_lanes_and_their_connections_are_drawn(ax):
    prediction = fake_prediction()
    draw_prediction(ax, prediction, threshold=0.3)
    shown = lines(ax)
    assert len(shown) == 3
    points = prediction.points[:2, :, :2]
    np.testing.assert_allclose(shown[:2], points, rtol=1e-6)
    np.testing.assert_allclose(shown[2], [points[0, -1], points[1, 0]], rtol=1e-6)


@pytest.mark.parametrize("queries", [0, 1])
def test_predictions_with_few_queries_are_drawn(ax, queries):
    logits = np.full((queries, 1), 3.0, np.float32)
    points = np.zeros((queries, POINTS, 3), np.float32)
    draw_prediction(ax, CenterlinePrediction(points, logits, np.full((queries, queries), -1.0)))
    assert len(lines(ax)) == queries


def test_nothing_above_the_threshold_draws_nothing(ax):
    draw_prediction(ax, fake_prediction(), threshold=0.99)
    assert lines(ax) == []
