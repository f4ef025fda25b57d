"""Boards with their lanes and roads of an SD map, from above: in their places, without padding, named in the legend."""

import numpy as np
import pytest

from tests.fakes import empty_example, fake_example
from tests.plots.test_bev import lines
from tflane_jax.plots import add_legend, new_figure
from tflane_jax.plots.bev import INPUTS, draw_scene, inputs_title
from tflane_jax.plots.priors import draw_markers, draw_sd_map
from tflane_jax.scene import MarkerObservations, RoadUser, SdMap

pytest.importorskip("matplotlib")
LANE = np.array([[0.0, 1.0, 0.0], [5.0, 1.0, 0.0], [9.0, 2.0, 0.0]], np.float32)


def boards(valid: int, padding: float = np.nan) -> MarkerObservations:
    """Return three boards, of which the first are valid, each with two lanes, of which one is."""
    markers = MarkerObservations.empty(3, 2, 3)
    markers.pose[:, 0, 3] = [20.0, 30.0, 40.0]
    markers.lanes[:, 0], markers.lanes[:, 1], markers.lane_valid[:, 0] = LANE, padding, True
    markers.pose[valid:], markers.lanes[valid:] = padding, padding
    markers.valid[:valid] = True
    return markers


def roads(valid: int) -> SdMap:
    """Return two roads, of which the first are valid."""
    sd_map = SdMap.empty(2, 2)
    sd_map.points[:], sd_map.points[valid:] = [[-9.0, 0.0], [9.0, 0.0]], np.nan
    sd_map.valid[:valid] = True
    return sd_map


@pytest.mark.parametrize("valid", [0, 1, 3])
def test_boards_stand_where_they_were_detected_with_the_valid_lanes_of_their_store(ax, valid):
    draw_markers(ax, boards(valid))
    assert [line.tolist() for line in lines(ax)] == [LANE[:, :2].tolist()] * valid
    places = np.asarray(ax.collections[-1].get_offsets())
    np.testing.assert_array_equal(places.reshape(-1, 2)[:, 0], [20.0, 30.0, 40.0][:valid])


@pytest.mark.parametrize("valid", [0, 1, 2])
def test_roads_of_an_sd_map(ax, valid):
    draw_sd_map(ax, roads(valid))
    assert [line.tolist() for line in lines(ax)] == [[[-9.0, 0.0], [9.0, 0.0]]] * valid


def test_a_panel_names_the_inputs_that_it_shows(ax):
    both = fake_example().replace(markers=boards(1), sd_map=roads(1))
    assert inputs_title(both) == "evidence, SD map, traffic and boards"
    assert inputs_title(both.replace(bev=None, traffic_flow=None, sd_map=None)) == "boards"
    assert inputs_title(fake_example()) == "evidence and traffic"
    assert inputs_title(empty_example().replace(bev=None, traffic_flow=None)) == "nothing"
    draw_scene(ax, both.replace(traffic_flow=None), layers=INPUTS)
    assert len(lines(ax)) == 2


def test_legends_name_the_inputs_that_the_examples_have():
    """Regression: pictures of models with cameras explained the colours of an evidence that they did not show."""

    def named(example):
        figure, _ = new_figure()
        add_legend(figure, examples=example)
        (legend,) = figure.legends
        return {text.get_text() for text in legend.get_texts()}

    example = fake_example()
    least = named(example.replace(bev=None, hidden=None, traffic_flow=None))
    board, road = {"board detected", "lane in its store"}, {"road of the SD map"}
    assert named(example.replace(markers=boards(0))) - named(example) == board
    assert named(example.replace(markers=boards(1), sd_map=roads(1))) - named(example) == board | road
    assert named(example) - named(example.replace(hidden=None)) == {"ground out of sight"}
    evidence = named(example) - named(example.replace(bev=None))
    assert evidence == {f"evidence: {name}" for name in ("lane paint", "road edge", "crossing", "obstacle")}
    users = named(example) - named(example.replace(traffic_flow=None))
    assert users == {*(user.name.lower() for user in RoadUser), "road user not seen"}
    assert named(example) == least | evidence | users | {"ground out of sight"}
    assert named(None) == named(example)
