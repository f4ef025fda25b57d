"""Pictures of lane segments: boundaries by type, crossings, from above and in the cameras."""

import jax
import numpy as np
import pytest

from tests.fakes import fake_example, fake_segments, fake_views
from tests.plots.pictures import count_colours
from tflane_jax.plots import Findings, save_camera_views, save_differences, save_examples, style
from tflane_jax.plots.bev import draw_found, draw_prediction, draw_scene
from tflane_jax.plots.cameras import draw_camera, legend_entries
from tflane_jax.plots.figure import new_figure
from tflane_jax.plots.legends import above_entries
from tflane_jax.plots.projection import draw_projected
from tflane_jax.plots.segments import (
    LINE_STYLES,
    boundary_types,
    chosen_areas,
    chosen_segments,
    draw_boundaries,
    draw_segments,
)
from tflane_jax.scene import AreaPrediction, AreaType, LineType, stack_examples

collections = pytest.importorskip("matplotlib.collections")
colors = pytest.importorskip("matplotlib.colors")


def with_segments(padding=0.0):
    """Return an example whose segments are its lanes, with boundaries at their sides; a solid one and a dashed one."""
    example = fake_example(0, padding=padding)
    across = np.array([0.0, 1.8, 0.0], np.float32)
    segments = example.lanes.replace(left=example.lanes.points + across, right=example.lanes.points - across)
    segments.left_type[:2], segments.right_type[:2] = LineType.SOLID, [LineType.DASHED, LineType.NONE]
    return example.replace(segments=segments, cameras=fake_views(0))


def drawn(ax):
    """Return the lines of the axes by colour and dash pattern."""
    found = [c for c in ax.collections if isinstance(c, collections.LineCollection) and len(c.get_segments())]
    return [
        (colors.to_hex(c.get_color()[0]), c.get_linestyle()[0], c.get_linewidth()[0], c.get_segments()) for c in found
    ]


def test_boundaries_are_drawn_by_type(ax):
    lines = np.cumsum(np.ones((4, 3, 3)), 1) + np.arange(4)[:, None, None]
    draw_boundaries(ax, lines, np.array([1, 2, 0, 2]), style.PREDICTION, width=2.0)
    patterns = [(dashes[1] is None, width, len(segments)) for _, dashes, width, segments in drawn(ax)]
    assert sorted(patterns) == [(False, 0.75 * 2.0, 1), (False, 2.0, 2), (True, 2.0, 1)]
    assert LINE_STYLES[LineType.SOLID] == "solid"


@pytest.mark.parametrize("padding", [0.0, np.nan])
def test_only_valid_segments_are_drawn(ax, padding):
    draw_segments(ax, with_segments(padding).segments)
    lines = [line for _, _, _, segments in drawn(ax) for line in segments]
    assert len(lines) == 6  # centerline, left and right of two segments
    assert np.isfinite(lines).all()
    light = [segments for colour, _, _, segments in drawn(ax) if colour == style.BOUNDARY]
    assert sum(map(len, light)) == 4


def test_a_scene_shows_segments_where_they_are_asked_for():
    counts = []
    for layers in (("lanes",), ("segments",), ()):
        ax = new_figure()[1][0, 0]
        draw_scene(ax, with_segments(), layers=layers)
        counts.append(sum(len(segments) for *_, segments in drawn(ax)))
    assert counts == [2, 6, 0]


def test_predicted_segments_crossings_and_links(ax):
    prediction = fake_segments()
    lanes, crossings = chosen_segments(prediction, 0.3)
    assert (lanes.tolist(), crossings.tolist()) == ([True, True, *[False] * 4], [False, False, True, *[False] * 3])
    assert [types.tolist() for types in boundary_types(prediction, lanes)] == [[1, 2], [0, 1]]
    draw_prediction(ax, prediction, threshold=0.3)
    blue = [segments for colour, _, _, segments in drawn(ax) if colour == style.PREDICTION]
    assert sum(map(len, blue)) == 6
    assert sum(colour == style.LINK for colour, *_ in drawn(ax)) == 1
    shapes = [c for c in ax.collections if isinstance(c, collections.PolyCollection)]
    ring = shapes[0].get_paths()[0].vertices[:-1]
    np.testing.assert_allclose(ring[:4], prediction.left[2, :, :2])
    np.testing.assert_allclose(ring[4:], prediction.right[2, ::-1, :2])


def test_areas_of_their_own_take_the_place_of_crossings(ax):
    segments = fake_segments()
    assert len(chosen_areas(segments, 0.5, AreaType.PEDESTRIAN_CROSSING)[0]) == 1
    assert len(chosen_areas(segments, 0.5, AreaType.ROAD_BOUNDARY)[0]) == 0
    lines = np.arange(3 * 5 * 3, dtype=np.float32).reshape(3, 5, 3)
    areas = AreaPrediction(lines, np.array([[2.0, -3.0], [-3.0, 1.0], [-3.0, -3.0]]))
    apart = segments.replace(areas=areas)
    rings, scores = chosen_areas(apart, 0.5, AreaType.PEDESTRIAN_CROSSING)
    np.testing.assert_array_equal(rings, lines[:1])
    np.testing.assert_allclose(scores, 1 / (1 + np.exp(-2.0)))
    np.testing.assert_array_equal(chosen_areas(apart, 0.5, AreaType.ROAD_BOUNDARY)[0], lines[1:2])
    before = len(ax.collections)
    draw_prediction(ax, apart, threshold=0.5)
    assert len(ax.collections) > before


@pytest.mark.parametrize("queries", [0, 1])
def test_few_queries_and_no_types(ax, queries):
    prediction = jax.tree.map(lambda leaf: leaf[:queries], fake_segments())
    prediction = prediction.replace(left_type_logits=None, right_type_logits=None, successor_logits=None)
    draw_found(ax, with_segments(), prediction)
    assert [types.tolist() for types in boundary_types(prediction, np.ones(queries, bool))] == [[1] * queries] * 2


def test_dashes_in_a_camera_have_gaps_on_the_ground():
    views, line = fake_views(), np.stack([np.linspace(5.0, 45.0, 2), np.zeros(2), np.zeros(2)], -1)[None]
    pieces = []
    for dash in (None, (2.0, 8.0)):
        ax = new_figure()[1][0, 0]
        draw_projected(ax, views, 0, line, colour="red", dash=dash)
        pieces.append(len(drawn(ax)[0][3]))
    assert pieces[1] == pytest.approx(pieces[0] / 4, rel=0.1)


def test_a_camera_shows_predicted_segments_by_type():
    ax, example = new_figure()[1][0, 0], with_segments()
    ahead = fake_segments()
    along = np.stack([np.linspace(6.0, 20.0, ahead.points.shape[1]), *np.zeros((2, ahead.points.shape[1]))], -1)
    across = np.array([0.0, 1.8, 0.0])
    sides = {"points": along, "left": along + across, "right": along - across}
    ahead = ahead.replace(**{name: np.broadcast_to(line, ahead.points.shape) for name, line in sides.items()})
    draw_camera(ax, example, 0, ahead)
    found = {colour for colour, *_ in drawn(ax)}
    assert {style.PREDICTION, style.CROSSING} <= found


def test_the_legend_of_camera_images_names_what_is_drawn():
    names = [entry.get_label() for entry in legend_entries(fake_segments())]
    assert names[:4] == ["solid boundary", "dashed boundary", "unmarked boundary", "crossing"]
    assert names[4:] == ["lane ahead", "to the left", "back", "to the right"]
    assert [entry.get_label() for entry in legend_entries(None)] == names[4:]
    above = [entry.get_label() for entry in above_entries(fake_segments(), with_segments())]
    assert above == ["truth, in predictions", "predicted lane (fainter: unsure)", "predicted topology"]
    truth = [entry.get_label() for entry in above_entries(None, with_segments())]
    assert truth[:4] == ["ground out of sight", "lane in sight", "lane partly in sight", "lane out of sight"]
    assert truth[4:6] == ["road boundary", "crossing"]
    assert truth[6:] == [
        *("car", "truck", "bus", "motorcycle", "bicycle", "pedestrian", "road user not seen"),
        *("traffic light", "traffic sign"),
    ]
    bare = with_segments().replace(hidden=None, traffic_flow=None, traffic_elements=None)
    assert [entry.get_label() for entry in above_entries(None, bare)] == truth[1:6]


@pytest.mark.slow
def test_pages_show_segments(tmp_path):
    examples = stack_examples([with_segments(np.nan), with_segments()])
    found = stack_examples([fake_segments(0), fake_segments(1)])
    paths = [
        save_examples(tmp_path / "a.png", examples, {"LaneSegNet": found}),
        save_camera_views(tmp_path / "b.png", examples, found),
        save_differences(
            tmp_path / "c.png",
            examples,
            {"one": Findings(found, 0.3, np.ones((2, 5), bool))},
            np.eye(2, 5, dtype=bool),
            title="t",
            titles=["a", "b"],
        ),
    ]
    for path in paths:
        assert count_colours(path) > 100
