"""OpenLane-V2's SD map: moved into the ego frame as the official devkit does, faults named."""

import json

import numpy as np
import pytest

from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.openlane_sd_map import (
    SdLines,
    SegmentSdMaps,
    frame_sd_map,
    read_sd_lines,
    sd_map_path,
    sd_records,
)
from tflane_jax.errors import UserError
from tflane_jax.files.openlane import FrameKey
from tflane_jax.geometry import PerceptionRange, yaw_pose
from tflane_jax.scene import SdCategory
from tflane_jax.world.roads.sd_map import SdMapConfig

CONFIG = SdMapConfig(lines=3, points=3, range=PerceptionRange((-50.0, 50.0), (-25.0, 25.0)))


def test_lines_are_moved_cut_and_numbered():
    """A road along the global y axis, seen by a vehicle at (10, 5) that drives along it."""
    pose = np.asarray(yaw_pose(10.0, 5.0, np.pi / 2))
    pose[2, 3] = 7.0
    lines = SdLines((np.array([[12.0, -95.0], [12.0, 105.0]]), np.array([[10.0, 8.0], [4.0, 8.0]])), (0, 1))
    found = frame_sd_map(lines, pose, CONFIG)
    assert found.valid.tolist() == [True, True, False]
    np.testing.assert_allclose(found.points[0], [[-50, -2], [0, -2], [50, -2]], atol=1e-5)
    np.testing.assert_allclose(found.points[1], [[3, 0], [3, 3], [3, 6]], atol=1e-5)
    assert found.category[:2].tolist() == [SdCategory.ROAD, SdCategory.CROSSWALK]
    roads = frame_sd_map(lines, pose, SdMapConfig(lines=3, points=3, crossings="exclude"))
    assert roads.valid.sum() == 1
    with pytest.warns(TruncationWarning, match="SdMapConfig.lines = 1"):
        nearest = frame_sd_map(lines, pose, SdMapConfig(lines=1, points=3))
    assert nearest.category[0] == SdCategory.ROAD


def test_a_written_file_is_read_back(tmp_path):
    lines = [np.array([[0.0, 1.0], [2.5, 3.25]]), np.array([[5.0, 5.0], [6.0, 7.0], [8.0, 9.0]])]
    path = tmp_path / "sdmap.json"
    path.write_text(json.dumps(sd_records(lines, [SdCategory.CROSSWALK, SdCategory.RESIDENTIAL])))
    found = read_sd_lines(path)
    for got, expected in zip(found.lines, lines, strict=True):
        np.testing.assert_array_equal(got, expected)
    assert found.category == (SdCategory.CROSSWALK, SdCategory.ROAD)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "is missing: unpack the SD maps"),
        ("{", "is no JSON file"),
        ({"points": []}, "expected a list"),
        ([{"points": [[0, 0], [1, 1]]}], "lacks the entry 'category'"),
        ([{"category": "river", "points": [[0, 0], [1, 1]]}], "category is 'river', expected one of road"),
        ([{"category": ["road"], "points": [[0, 0], [1, 1]]}], "expected one of road"),
        ([{"category": "road", "points": [[0, 0, 0, 0]]}], r"has shape \(1, 4\), expected \(any, 2\)"),
        ([{"category": "road", "points": [[0, None]]}], "points holds a value missing"),
    ],
)
def test_faults_are_named(tmp_path, content, said):
    path = tmp_path / "sdmap.json"
    if content is not None:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(UserError, match=said) as error:
        read_sd_lines(path)
    assert str(path) in str(error.value)


def test_lines_of_one_point_are_left_out(tmp_path):
    path = tmp_path / "sdmap.json"
    path.write_text('[{"category": "side_walk", "points": [[1, 2]]}, {"category": "road", "points": []}]')
    assert read_sd_lines(path).lines == ()
    assert not frame_sd_map(read_sd_lines(path), np.eye(4), CONFIG).valid.any()


def test_missing_files_are_told_before_a_frame_is_read(tmp_path):
    keys = [FrameKey("train", segment, "1") for segment in ("1", "2")]
    sd_map_path(tmp_path, keys[0]).parent.mkdir(parents=True)
    sd_map_path(tmp_path, keys[0]).write_text("{")  # damaged: not read yet
    SegmentSdMaps(tmp_path, keys[:1])
    with pytest.raises(UserError, match=r"1 of 2 SD maps are missing \(.*2/sdmap\.json, \.\.\.\): unpack the SD maps"):
        SegmentSdMaps(tmp_path, keys)
