"""Every reader of recorded drives refuses moving vehicles that do not head where they move."""

import json

import numpy as np
import pytest

from tests.datasets.nuscenes_small import EAST, NORTH, box, tables, write_nuscenes
from tests.datasets.small_argoverse2 import FRAMES, write, write_log
from tests.datasets.small_argoverse2 import box as argoverse2_box
from tests.datasets.test_nuscenes_scenes import content
from tests.datasets.test_nuscenes_scenes import write as write_scene
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, check_log
from tflane_jax.datasets.nuscenes_scene_files import read_scene_file
from tflane_jax.datasets.nuscenes_tracks import SceneTracks
from tflane_jax.errors import UserError

SAID = "3 of 3 moving vehicles do not head where they move"


def test_argoverse2(tmp_path):
    pytest.importorskip("pyarrow.feather")
    folder = write_log(tmp_path / "log-a")
    for turned in (False, True):  # the hand-made box heads backwards
        rows = [
            argoverse2_box(f, f"car {k}", "REGULAR_VEHICLE", 10.0 + f + 6 * k) for f in range(FRAMES) for k in range(3)
        ]
        write(folder / ANNOTATIONS, rows if turned else [row | {"qw": 1.0, "qz": 0.0} for row in rows])
        faults = check_log(folder)
        assert len(faults) == turned
        assert not turned or f"{ANNOTATIONS}: {SAID} (the median of all is 180 degrees off)" in faults[0]


def test_scene_files(tmp_path):
    scene, frames, cars = content(), 4, 3
    north = np.stack(
        [np.full((frames, cars), 8.0), 30.0 + 4.0 * np.arange(frames)[:, None] + 6.0 * np.arange(cars)], -1
    )
    scene |= {
        "instance_token": np.array(["a", "b", "c"]),
        "category": np.array(["vehicle.car"] * cars),
        "size_wlh": np.tile([2.0, 4.5, 1.6], (cars, 1)),
        "position": np.concatenate([north, np.ones((frames, cars, 1))], -1),
        "yaw": np.full((frames, cars), np.pi / 2),
        "valid": np.ones((frames, cars), bool),
        "ego_position": np.tile([10.0, 20.0, 0.0], (frames, 1)),
        "ego_yaw": np.full(frames, np.pi / 2),
    }
    assert read_scene_file(write_scene(tmp_path / "right.npz", scene)).tracks.valid.all()
    # Clockwise in place of counter-clockwise.
    path = write_scene(tmp_path / "turned.npz", scene | {"yaw": -scene["yaw"]})
    with pytest.raises(UserError, match=rf"turned\.npz: yaw: {SAID}"):
        read_scene_file(path)


def test_nuscenes_tables(tmp_path):
    root = write_nuscenes(tmp_path)
    file = next(root.glob("*/sample_annotation.json"))
    for heading in (NORTH, EAST):  # they drive north
        content = tables()
        extra = [
            box(f"more-{k}-{i}", f"sample-a{i}", f"more-{k}", (404.0, 1100.0 + 5 * i + 8 * k, 1.0), heading)
            for k in range(3)
            for i in range(4)
        ]
        kinds = [{"token": f"more-{k}", "category_token": "is-vehicle.car"} for k in range(3)]
        file.write_text(json.dumps(content["sample_annotation"] + extra))
        (file.parent / "instance.json").write_text(json.dumps(content["instance"] + kinds))
        if heading is NORTH:
            assert len(SceneTracks(root).log("scene-0061").tracks.uuid) == 6
    with pytest.raises(UserError, match=rf"sample_annotation\.json: boxes from sample sample-a0 on: {SAID}"):
        SceneTracks(root).log("scene-0061")
