"""A submission holds what was detected, at the official numbers of points, and its own reader takes it."""

import pickletools
from dataclasses import replace

import numpy as np
import pytest

from tests.fakes import fake_prediction, fake_segments
from tflane_jax.commands.submit import _record
from tflane_jax.datasets.view_images import ImageConfig, fit_image
from tflane_jax.evaluation.centerlines import detections_of_centerlines
from tflane_jax.evaluation.lane_segments import detections_of_segments
from tflane_jax.files.openlane import FrameKey
from tflane_jax.files.plain_pickle import load_plain_pickle
from tflane_jax.metrics.frames import ElementDetections, LaneDetections
from tflane_jax.metrics.segment_matching import AreaDetections, SegmentDetections
from tflane_jax.scene import Prediction
from tflane_jax.scoring.openlane_v2 import read_predictions, read_segment_predictions
from tflane_jax.scoring.submission import (
    Author,
    best_lanes,
    best_segments,
    centerline_record,
    segment_record,
    write_submission,
)

KEY = FrameKey("test", "00007", "315966070559696000")
NO_AREAS = AreaDetections([], np.zeros(0, int), np.zeros(0))


def straight_lines(rng: np.random.Generator, lines: int, points: int) -> np.ndarray:
    """Return lines with equally spaced points, which resampling to the same number leaves as they are."""
    start, step = rng.uniform(-20.0, 20.0, (2, lines, 1, 3))
    return start + step * np.linspace(0.0, 1.0, points)[:, None]


def detections(lanes: int, points: int, elements: int | None = 3) -> LaneDetections:
    rng = np.random.default_rng(lanes + points)
    found = None
    if elements is not None:
        low = rng.uniform(0.0, 500.0, (elements, 1, 2))
        boxes = np.concatenate([low, low + rng.uniform(5.0, 50.0, low.shape)], 1)
        scores = rng.random(elements)
        found = ElementDetections(boxes, rng.integers(0, 13, elements), scores, rng.random((lanes, elements)))
    return LaneDetections(straight_lines(rng, lanes, points), rng.random(lanes), rng.random((lanes, lanes)), found)


def same_lanes(found: LaneDetections, wanted: LaneDetections) -> None:
    np.testing.assert_allclose(np.array(found.points), wanted.points, atol=1e-5)
    np.testing.assert_allclose(found.scores, wanted.scores)
    np.testing.assert_allclose(found.successor, wanted.successor, rtol=1e-6)
    assert found.elements is not None
    assert wanted.elements is not None
    for name in ("boxes", "attributes", "scores", "lane"):
        np.testing.assert_allclose(getattr(found.elements, name), getattr(wanted.elements, name), rtol=1e-6)


@pytest.mark.parametrize(("lanes", "elements"), [(5, 3), (1, 0), (0, 2)])
def test_centerlines_come_back(tmp_path, lanes, elements):
    wanted = detections(lanes, 11, elements)
    path = write_submission(tmp_path / "submission.pkl", {KEY: centerline_record(wanted)}, Author())
    (found,) = read_predictions(path).values()
    if lanes:
        same_lanes(found, wanted)
    assert (len(found.points), len(found.elements.scores)) == (lanes, elements)


def test_segments_come_back(tmp_path):
    rng = np.random.default_rng(3)
    areas = AreaDetections(straight_lines(rng, 2, 20), np.array([1, 2]), rng.random(2))
    left, right = straight_lines(rng, 4, 10), straight_lines(rng, 4, 10)
    wanted = SegmentDetections(detections(4, 10), left, right, areas, np.array([0, 1, 2, 1]), np.array([2, 2, 0, 1]))
    path = write_submission(tmp_path / "submission.pkl", {KEY: segment_record(wanted)}, Author())
    (found,) = read_segment_predictions(path).values()
    same_lanes(found.lanes, wanted.lanes)
    for name in ("left", "right", "left_type", "right_type"):
        np.testing.assert_allclose(np.array(getattr(found, name)), getattr(wanted, name), atol=1e-5)
    for name in ("points", "categories", "scores"):
        np.testing.assert_allclose(np.array(getattr(found.areas, name)), getattr(areas, name), atol=1e-5)


@pytest.mark.parametrize(("lanes", "elements"), [(2, 1), (0, 0), (9, None), (None, 2)])
def test_the_best_lanes_and_elements_keep_order_and_relations(lanes, elements):
    found = detections(5, 11)
    kept = best_lanes(found, lanes, elements)
    rows = np.sort(np.argsort(-found.scores)[:lanes])
    columns = np.sort(np.argsort(-found.elements.scores)[:elements])
    np.testing.assert_array_equal(np.reshape(kept.points, (-1, 11, 3)), found.points[rows])
    np.testing.assert_array_equal(kept.scores, found.scores[rows])
    np.testing.assert_array_equal(kept.successor, found.successor[rows][:, rows])
    np.testing.assert_array_equal(kept.elements.boxes, found.elements.boxes[columns])
    np.testing.assert_array_equal(kept.elements.lane, found.elements.lane[rows][:, columns])
    segments = SegmentDetections(found, found.points + 1.0, found.points - 1.0, NO_AREAS, np.arange(5))
    few = best_segments(segments, lanes, elements)
    np.testing.assert_array_equal(few.lanes.scores, kept.scores)
    np.testing.assert_array_equal(np.reshape(few.right, (-1, 11, 3)), found.points[rows] - 1.0)
    np.testing.assert_array_equal(few.left_type, rows)
    assert few.right_type is None


def test_of_equal_scores_the_first_are_kept():
    found = replace(detections(4, 11, None), scores=np.array([0.5, 0.5, 0.9, 0.5]))
    np.testing.assert_array_equal(np.array(best_lanes(found, 2, None).points), found.points[[0, 2]])


def test_lines_get_the_official_number_of_points():
    straight = np.linspace([0.0, 0.0, 0.0], [30.0, 0.0, 0.0], 4)[None]
    found = LaneDetections(straight, np.ones(1), np.zeros((1, 1)))
    (lane,) = centerline_record(found)["lane_centerline"]
    np.testing.assert_allclose(lane["points"][:, 0], np.linspace(0.0, 30.0, 11), rtol=1e-6)
    assert centerline_record(found)["topology_lcte"].shape == (1, 0)
    areas = AreaDetections(straight, np.array([1]), np.ones(1))
    record = segment_record(SegmentDetections(found, straight, straight, areas))
    lines = ("centerline", "left_laneline", "right_laneline")
    assert {len(record["lane_segment"][0][name]) for name in lines} == {10}
    assert record["lane_segment"][0]["left_laneline_type"] == 0
    assert len(record["area"][0]["points"]) == 20


def test_lines_with_the_official_number_of_points_are_resampled_too():
    """As TopoNet and LaneSegNet write them; the sides of a crossing are two lines."""
    rng = np.random.default_rng(5)

    def uneven(points: int) -> np.ndarray:
        along = np.sort(np.concatenate([[0.0, 30.0], rng.uniform(0.0, 30.0, points - 2)]))
        return np.stack([along, np.full(points, 2.0), 0.1 * along], -1)[None]

    (lane,) = centerline_record(LaneDetections(uneven(11), np.ones(1), np.zeros((1, 1))))["lane_centerline"]
    even = np.linspace([0.0, 2.0, 0.0], [30.0, 2.0, 3.0], 11)
    np.testing.assert_allclose(lane["points"], even, atol=1e-5)

    sides = np.concatenate([uneven(10), uneven(10)[:, ::-1] + np.array([0.0, 4.0, 0.0])], 1)
    found = SegmentDetections(
        LaneDetections(uneven(10), np.ones(1), np.zeros((1, 1))),
        uneven(10),
        uneven(10),
        AreaDetections(sides, np.array([1]), np.ones(1)),
    )
    (segment,) = segment_record(found)["lane_segment"]
    even = np.linspace([0.0, 2.0, 0.0], [30.0, 2.0, 3.0], 10)
    for name in ("centerline", "left_laneline", "right_laneline"):
        np.testing.assert_allclose(segment[name], even, atol=1e-5)
    both = np.concatenate([even, even[::-1] + np.array([0.0, 4.0, 0.0])])
    (crossing,) = segment_record(found, "sides")["area"]
    np.testing.assert_allclose(crossing["points"], both, atol=1e-5)
    (ring,) = segment_record(found, "ring")["area"]
    apart = np.linalg.norm(np.diff(ring["points"][:, :2], axis=0), axis=-1)
    assert np.isclose(apart, 64.0 / 19.0, atol=1e-3).sum() >= 16  # all but those across a corner


def test_the_file_has_what_the_server_asks_for(tmp_path):
    author = Author("TF", ("A. B.", "C. D."), "a@b.c", "None", "NL")
    record = centerline_record(detections(2, 11))
    content = load_plain_pickle(write_submission(tmp_path / "s.pkl", {KEY: record}, author))
    head = {"method": "TF", "authors": ["A. B.", "C. D."], "e-mail": "a@b.c"}
    head |= {"institution / company": "None", "country / region": "NL"}
    assert {name: content[name] for name in head} == head
    assert list(content["results"]) == [("test", "00007", "315966070559696000")]
    assert [e["category"] for e in record["traffic_element"]] == [
        1 if e["attribute"] <= 3 else 2 for e in record["traffic_element"]
    ]


def test_lanes_elements_and_areas_have_different_ids():
    """The official check joins the ids of lanes and traffic elements and refuses repeated ones."""
    centerlines = centerline_record(detections(4, 11))
    segments = SegmentDetections(
        detections(4, 10),
        *(np.zeros((4, 10, 3)),) * 2,
        AreaDetections(np.zeros((3, 20, 3)), np.ones(3, int), np.ones(3)),
    )
    for record, lists in (
        (centerlines, ("lane_centerline", "traffic_element")),
        (segment_record(segments), ("lane_segment", "traffic_element", "area")),
    ):
        ids = [thing["id"] for name in lists for thing in record[name]]
        assert len(ids) == len(set(ids)) >= 7


def test_what_the_author_leaves_out_is_not_in_the_file(tmp_path):
    """The official check fails for an empty country, and only reports one that is absent."""
    path = write_submission(tmp_path / "s.pkl", {KEY: centerline_record(detections(2, 11))}, Author("TF", team="T"))
    content = load_plain_pickle(path)
    assert {name: content[name] for name in content if name != "results"} == {"method": "TF", "team": "T"}


def test_the_file_opens_with_the_numpy_of_the_official_program(tmp_path):
    """Before numpy 2, the module of arrays had another name; the official program needs numpy below 1.24."""
    path = write_submission(tmp_path / "s.pkl", {KEY: centerline_record(detections(2, 11))}, Author())
    named = [argument for opcode, argument, _ in pickletools.genops(path.read_bytes()) if opcode.name == "GLOBAL"]
    assert "numpy.core.multiarray _reconstruct" in named
    assert not any("_core" in name for name in named)


def test_boxes_go_back_to_pixels_of_the_file():
    fit = fit_image(1550, 2048, ImageConfig(front_rows=(356, 1906), scale=0.5), front=True)
    boxes = np.array([[[100.0, 600.0], [180.0, 700.0]]])
    np.testing.assert_allclose(fit.in_file(fit.boxes(boxes)), boxes)


@pytest.mark.parametrize("lanes", ["centerlines", "segments"])
def test_a_submission_has_the_edges_that_are_evaluated(lanes):
    """Regression: with `evaluation.topology` "geometric", `tflane eval` measured others than were submitted."""
    lines = fake_prediction() if lanes == "centerlines" else fake_segments()
    field = "topology_lclc" if lanes == "centerlines" else "topology_lsls"
    answer = Prediction(**{lanes: lines})
    learned, sums = (_record(None, answer, None, None, way)[field] for way in ("learned", "geometric"))
    detections = detections_of_centerlines if lanes == "centerlines" else detections_of_segments
    found = detections(lines, None, "geometric")
    expected = found.successor if lanes == "centerlines" else found.lanes.successor
    np.testing.assert_allclose(sums, expected, rtol=1e-6)
    assert (np.asarray(sums) > learned).any()
