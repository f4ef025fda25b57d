"""The picture of a drive's frame: boards from above, with labels that can be read."""

import numpy as np
import pytest

from tests.fakes import fake_segments
from tflane_jax.geometry import PerceptionRange
from tflane_jax.markers.detection import DetectedMarkers
from tflane_jax.plots import marker_drive, projection, style
from tflane_jax.priors.marker_memory import MarkerGuidance
from tflane_jax.scene import CameraViews, LineClass, LinePrediction

pytest.importorskip("matplotlib")

NO_LANES = MarkerGuidance(
    points=np.zeros((0, 2, 2)),
    weight=np.zeros(0),
    confidence=np.zeros(0),
    gate=np.zeros(()),
    successor=np.zeros((0, 0), bool),
    valid=np.zeros(0, bool),
)


@pytest.mark.parametrize("place", [(0.0, 0.0), (49.5, -24.5), (49.5, 24.5), (-49.5, -24.5), (-49.5, 24.5)])
def test_the_label_of_a_board_lies_beside_it_and_in_the_panel(place, tmp_path, monkeypatch):
    found = DetectedMarkers.empty(1)
    found.valid[:], found.marker_id[:], found.size[:], found.pose[0, :2, 3] = True, 98, 1.0, place
    front = np.array([[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1]], np.float32)[None]
    size, intrinsics = np.array([[64, 48]]), np.array([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]])
    views = CameraViews(np.zeros((1, 48, 64, 3), np.uint8), size, intrinsics, front, np.ones(1, bool))
    drawn = []
    monkeypatch.setattr(marker_drive, "save_figure", lambda figure, path: drawn.append(figure))
    marker_drive.save_drive_frame(
        tmp_path / "x.png", views, found, {98: "used"}, {98: 0.51}, NO_LANES, view=PerceptionRange()
    )
    (figure,) = drawn
    figure.draw_without_rendering()
    panel = figure.axes[1]
    (label,) = (text for text in panel.texts if text.get_text() == "98: 0.51")
    box, frame = label.get_window_extent(), panel.get_window_extent()
    assert frame.x0 <= box.x0 <= box.x1 <= frame.x1
    assert frame.y0 <= box.y0 <= box.y1 <= frame.y1
    board = panel.transData.transform(place)
    half = 3.0 * figure.dpi / 72.0  # of the square
    outside = np.maximum([box.x0 - board[0], box.y0 - board[1]], [board[0] - box.x1, board[1] - box.y1])
    assert outside.max() >= half


def panel_from_above(place, guidance, folder, monkeypatch):
    """Return the panel from above of a frame that detects board 98 at a place."""
    found = DetectedMarkers.empty(1)
    found.valid[:], found.marker_id[:], found.size[:], found.pose[0, :2, 3] = True, 98, 1.0, place
    image, matrix = np.zeros((1, 48, 64, 3), np.uint8), np.eye(4, dtype=np.float32)[None]
    views = CameraViews(image, np.array([[64, 48]]), np.eye(3)[None], matrix, np.ones(1, bool))
    drawn = []
    monkeypatch.setattr(marker_drive, "save_figure", lambda figure, path: drawn.append(figure))
    outcome, confidence = {98: "used"}, {98: 0.51}
    marker_drive.save_drive_frame(folder / "x.png", views, found, outcome, confidence, guidance, view=PerceptionRange())
    drawn[0].draw_without_rendering()
    return drawn[0].axes[1]


@pytest.mark.parametrize(("y", "up"), [(5.0, True), (-5.0, False)])
def test_the_label_of_a_board_lies_on_the_side_away_from_lanes_and_can_be_read_on_them(y, up, tmp_path, monkeypatch):
    lane = np.stack([np.linspace(0.0, 40.0, 21), np.zeros(21)], -1)[None]
    guidance = MarkerGuidance(lane, np.ones(1), np.ones(1), np.ones(()), np.zeros((1, 1), bool), np.ones(1, bool))
    panel = panel_from_above((10.0, y), guidance, tmp_path, monkeypatch)
    (label,) = (text for text in panel.texts if text.get_text() == "98: 0.51")
    box, board = label.get_window_extent(), panel.transData.transform((10.0, y))
    assert (box.y0 > board[1]) if up else (box.y1 < board[1])
    assert label.get_path_effects()


def test_boards_out_of_the_panel_have_no_label(tmp_path, monkeypatch):
    panel = panel_from_above((70.0, 0.0), NO_LANES, tmp_path, monkeypatch)
    assert [text.get_text() for text in panel.texts if "98" in text.get_text()] == []


@pytest.mark.parametrize("side", [(-13.9, 8.4), (13.9, 8.4), (-13.9, -10.6), (13.9, -10.6), (0.0, 0.0)])
def test_the_label_of_a_board_lies_in_the_image(side, tmp_path, monkeypatch):
    """Boards in the corners of an image of 64 x 48 pixels, 25 m ahead."""
    found = DetectedMarkers.empty(1)
    found.valid[:], found.marker_id[:], found.size[:] = True, 98, 1.0
    found.pose[0, :3, :3] = np.array([[0, 0, -1], [1, 0, 0], [0, 1, 0]])
    found.pose[0, :3, 3] = 25.0, -side[0], 1.5 - side[1]
    front = np.array([[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1]], np.float32)[None]
    size, intrinsics = np.array([[64, 48]]), np.array([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]])
    views = CameraViews(np.zeros((1, 48, 64, 3), np.uint8), size, intrinsics, front, np.ones(1, bool))
    drawn = []
    monkeypatch.setattr(marker_drive, "save_figure", lambda figure, path: drawn.append(figure))
    outcome = {98: "contradictory"}
    marker_drive.save_drive_frame(tmp_path / "x.png", views, found, outcome, {}, NO_LANES, view=PerceptionRange())
    drawn[0].draw_without_rendering()
    panel = drawn[0].axes[0]
    (label,) = (text for text in panel.texts if text.get_text() == "98: contradictory")
    box, frame = label.get_window_extent(), panel.get_window_extent()
    assert frame.x0 - 1 <= box.x0 <= box.x1 <= frame.x1 + 1
    assert frame.y0 - 1 <= box.y0 <= box.y1 <= frame.y1 + 1


def test_the_title_says_whether_there_are_lanes_and_from_where():
    some = NO_LANES.replace(valid=np.ones(1, bool), gate=np.array(0.7))
    titles = [marker_drive.frame_title(4, some, remembered=remembered) for remembered in (False, True)]
    assert titles == ["frame 4: lanes of a board in sight, c = 0.70", "frame 4: lanes from memory, c = 0.70"]
    assert marker_drive.frame_title(4, NO_LANES, remembered=False) == "frame 4: no lanes of a board"


def frame_with(prediction, folder, monkeypatch):
    """Return the figure of a frame with one board, and the lines that its camera shows, by colour."""
    found = DetectedMarkers.empty(1)
    found.valid[:], found.marker_id[:], found.size[:], found.pose[0, :2, 3] = True, 98, 1.0, (10.0, 2.0)
    image, matrix = np.zeros((1, 48, 64, 3), np.uint8), np.eye(4, dtype=np.float32)[None]
    views = CameraViews(image, np.array([[64, 48]]), np.eye(3)[None], matrix, np.ones(1, bool))
    figures, shown = [], {}

    def projected(ax, views, number, lines, *, colour, **_):
        shown[colour] = np.asarray(lines)

    monkeypatch.setattr(marker_drive, "save_figure", lambda figure, path: figures.append(figure))
    monkeypatch.setattr(marker_drive, "draw_projected", projected)
    monkeypatch.setattr(projection, "draw_projected", projected)
    marker_drive.save_drive_frame(
        folder / "x.png", views, found, {98: "used"}, {98: 0.5}, NO_LANES, prediction, view=PerceptionRange()
    )
    return figures[0], shown


def entries(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_crossing_is_no_lane_in_the_cameras(tmp_path, monkeypatch):
    segments = fake_segments()
    figure, shown = frame_with(segments, tmp_path, monkeypatch)
    np.testing.assert_array_equal(shown[style.PREDICTION], segments.points[:2])
    assert "predicted lane" in entries(figure)


def test_lines_of_a_map_have_the_colours_of_their_classes(tmp_path, monkeypatch):
    logits = np.full((3, 3), -9.0)
    logits[0, LineClass.DIVIDER] = logits[1, LineClass.CROSSING] = 2.0
    points = np.arange(24.0).reshape(3, 4, 2)
    figure, shown = frame_with(LinePrediction(points, logits), tmp_path, monkeypatch)
    for number, kind in enumerate((LineClass.DIVIDER, LineClass.CROSSING)):
        np.testing.assert_array_equal(shown[style.MAP_LINE[kind]][0, :, :2], points[number])
    assert len(shown[style.MAP_LINE[LineClass.BOUNDARY]]) == 0
    assert "crossing" in entries(figure)
    assert "predicted lane" not in entries(figure)
