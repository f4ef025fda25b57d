"""Boards with their lanes and roads of an SD map, from above: in their places, without padding, named in the legend."""

import numpy as np
import pytest

from tests.fakes import empty_example, fake_example
from tests.plots.test_bev import lines
from tflane_jax.plots import gallery
from tflane_jax.plots.bev import INPUTS, draw_scene, inputs_title
from tflane_jax.plots.gallery import save_examples
from tflane_jax.plots.priors import draw_markers, draw_sd_map, prior_entries
from tflane_jax.scene import MarkerObservations, SdMap, stack_examples

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


def test_the_legend_names_priors_that_the_examples_have(tmp_path, monkeypatch):
    named = []
    monkeypatch.setattr(gallery, "add_legend", lambda *_, priors, **__: named.extend(e.get_label() for e in priors))
    for more in ({}, {"markers": boards(1)}, {"markers": boards(0), "sd_map": roads(1)}):
        save_examples(tmp_path / "a.png", stack_examples([fake_example().replace(**more)]))
    board = ["board detected", "lane in its store"]
    assert named == [*board, *board, "road of the SD map"]
    assert prior_entries(fake_example()) == []
