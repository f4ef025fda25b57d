"""LSTR's published weights on real images: photos without hints about their cameras, and the warm start of the GTN."""

import json

import numpy as np
import pytest

from benchmarks import photo_views
from tests.shared import ROOT, shared_path
from tflane_jax.cli import main

pytest.importorskip("cv2")
pytestmark = [pytest.mark.slow, pytest.mark.golden]

# Three cameras: their images, the row in which the lines of the road meet (the nuScenes cameras look straight ahead: at
# the front the calibrated principal point; the road behind sinks), and how many lanes can be seen at least.
PHOTOS = {
    "tusimple": ("tusimple/LaneDetection/clips/0313-1/6040/20.jpg", 240, 3),
    "front": ("nuscenes_keyframe/samples/CAM_FRONT/*.jpg", 490, 2),
    "rear": ("nuscenes_keyframe/samples/CAM_BACK/*.jpg", 515, 2),
}


def weights():
    return ["--weights", str(shared_path("data/lstr/LSTR_500000.npz"))]


def photo_of(pattern):
    path = shared_path("data") / pattern
    return shared_path(path.parent.relative_to(shared_path("."))) / next(path.parent.glob(path.name)).name


def columns(lane, rows):
    """Columns of a lane at rows, continued at both ends along the straight line of that half."""
    points = np.array(lane["points"])
    half = max(len(points) // 2, 2)
    found = np.interp(rows, points[:, 1], points[:, 0])
    for part, beyond in ((points[:half], rows < points[0, 1]), (points[-half:], rows > points[-1, 1])):
        slope, start = np.polyfit(part[:, 1], part[:, 0], 1)
        found = np.where(beyond, start + slope * rows, found)
    return found


def test_photos_of_three_cameras_give_plausible_lanes_without_hints(tmp_path):
    """Lanes below the horizon that keep their order and draw together towards it."""
    files = [photo_of(pattern) for pattern, _, _ in PHOTOS.values()]
    command = ["predict", "--config", "gtn_lane/lstr", *weights(), *map(str, files), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    found = json.loads((tmp_path / "out" / "predictions.json").read_text())["photos"]
    for record, (name, (_, horizon, least)) in zip(found, PHOTOS.items(), strict=True):
        lanes, width = record["lanes"], record["width"]
        assert record["warning"] == "", name
        assert len(lanes) >= least, name
        assert min(lane["points"][0][1] for lane in lanes) >= horizon - 40, name
        assert all(lane["score"] >= 0.5 and lane["paint"] > 0.1 for lane in lanes), name
        rows = np.linspace(horizon + 60, record["height"] - 1, 20)
        apart = np.diff(sorted((columns(lane, rows) for lane in lanes), key=lambda c: c[-1]), axis=0)
        assert (apart > 0).all(), name
        assert (apart[:, 0] < 0.2 * apart[:, -1]).all(), name
        at_horizon = [float(columns(lane, np.array([horizon]))[0]) for lane in lanes]
        assert np.ptp(at_horizon) < 0.08 * width, name


@pytest.mark.parametrize("name", [*list(photo_views.FRAMES)[1:], *photo_views.STREET])
def test_photos_of_any_size_and_shape_keep_their_lanes(name):
    """As many labelled points as docs/gtn_lane.md says, but for some: three of the ten frames."""
    data = shared_path("data")
    reader, change = photo_views.published_reader(data), (photo_views.FRAMES | photo_views.STREET)[name]
    photos = list(photo_views.frames(data))[::4] if name in photo_views.FRAMES else [photo_views.street(data)]
    found = [(reader.read(photo.image), photo) for photo in map(change, photos)]
    scores = [photo_views.score(list(answer.lanes), photo) for answer, photo in found]
    hits, points, false, lanes = np.sum(scores, 0)
    assert hits > 0.7 * points
    assert false <= 1
    assert lanes >= 3 * len(photos)


def test_photos_without_a_road_have_no_lanes():
    data = shared_path("data")
    reader = photo_views.published_reader(data)
    for image in list(photo_views.roadless(data))[::3]:
        answer = reader.read(np.ascontiguousarray(image))
        assert answer.lanes == ()
        assert answer.warning


@pytest.mark.parametrize("weight", ["1", "0.98"])
def test_a_warm_started_gtn_has_the_accuracies_of_the_page(weight, tmp_path):
    run, gtn = tmp_path / "run", ["--config", "gtn_lane/gtn_tusimple"]
    frames = ["--root", str(shared_path("data/tusimple/LaneDetection")), "--split", "train"]
    assert main(["convert", *gtn, *weights(), "--edge-weight", weight, "--out", str(run)]) == 0
    assert main(["eval", str(run), *frames, "--out", str(tmp_path / "score")]) == 0
    (row,) = json.loads((tmp_path / "score.json").read_text())["rows"]
    page = (ROOT / "docs" / "gtn_lane.md").read_text()
    cells = next(line.split("|")[3:6] for line in page.splitlines() if line.startswith(f"| GTN | {weight} |"))
    for name, cell in zip(("Accuracy", "FP", "FN"), cells, strict=True):
        decimals = len(cell.strip().partition(".")[2])
        assert round(row[name], decimals) == float(cell), name
    # The picture and the table of the selection, which is what was asked for.
    selected = json.loads((tmp_path / "score-edge_types.json").read_text())["rows"]
    assert len(selected) == 2 * 2 * 2
    for each in selected:
        wins = "similarity" if each["hop"] == 2 else "self"
        assert each["wins"] == wins
        assert each[wins] == pytest.approx(float(weight), abs=1e-4)
