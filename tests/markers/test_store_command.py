"""`tflane markers store`."""

import datetime
import json

import numpy as np
import pytest

from tests.shared import shared_path
from tflane_jax.cli import main
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, load_log
from tflane_jax.datasets.marker_observations import markers_of
from tflane_jax.geometry import transform_points
from tflane_jax.markers.store_files import load_store
from tflane_jax.world.simulate import simulate

SCENE = 200_000_034


def test_the_store_of_a_scene(tmp_path, capsys):
    path = tmp_path / "new" / "store.json"
    arguments = ["--out", str(path), "--radius", "30", "--surveyed", "2025-07-11", "--expires", "2026-07-11"]
    assert main(["markers", "store", "--log", str(SCENE), *arguments]) == 0
    placed = simulate(SCENE).markers
    assert placed is not None
    stored = load_store(path).markers
    assert sorted(stored) == sorted(placed.marker_id.tolist())
    for number, pose in zip(placed.marker_id, placed.pose, strict=True):
        marker = stored[int(number)]
        np.testing.assert_array_equal(marker.global_from_marker, pose)
        assert (marker.surveyed, marker.expires) == (datetime.date(2025, 7, 11), datetime.date(2026, 7, 11))
        lines = transform_points(pose, marker.lanes.reshape(-1, 3))
        assert len(lines)
        assert np.linalg.norm(lines[:, :2] - pose[:2, 3], axis=-1).max() <= 30.001
    assert str(path) in capsys.readouterr().out
    # In the map's frame the lanes are where they are on the map: on its ground.
    assert main(["markers", "store", "--log", str(SCENE), "--out", str(path), "--frame", "survey"]) == 0
    record = json.loads(path.read_text())
    assert record["frame"] == "survey"
    assert all(point[2] == 0.0 for marker in record["markers"] for line in marker["lanes"] for point in line)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--log", "nowhere"], "neither a scene number nor a folder"),
        (["--log", "200000040"], "has no junction, split or merge"),
        (["--log", "1", "--radius", "0"], "--radius must be more than 0 and up to 100000 m"),
        (["--log", "1", "--radius", "1e200"], "up to 100000 m, not 1e+200"),
        (["--log", "1", "--expires", "soon"], "--expires soon is no day"),
        (["--log", "1", "--surveyed", "2025-07-11", "--expires", "2025-07-11"], "--expires 2025-07-11 must be after"),
        (["--log", "1", "--surveyed", "2025-07-11", "--expires", "2024-07-11"], "must be after --surveyed 2025-07-11"),
    ],
)
def test_errors_name_the_remedy(tmp_path, arguments, message, capsys):
    out = tmp_path / "store.json"
    assert main(["markers", "store", *arguments, "--out", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("level", ["", "sensor", "sensor/val"])
def test_a_folder_of_logs_names_one_of_them(tmp_path, level, capsys):
    """Regression: its annotations.feather was to be downloaded."""
    for log in ("b", "a"):
        (tmp_path / "sensor" / "val" / log).mkdir(parents=True)
        (tmp_path / "sensor" / "val" / log / ANNOTATIONS).touch()
    assert main(["markers", "store", "--log", str(tmp_path / level), "--out", str(tmp_path / "store.json")]) == 2
    said = capsys.readouterr().err
    assert "is a folder of logs, and a store is of one: name it, such as " in said
    assert str(tmp_path / "sensor" / "val" / "a") in said


def test_real_logs_get_virtual_markers(tmp_path):
    folder = shared_path("data/argoverse2/sensor/val/adcf7d18-0510-35b0-a2fa-b4cea13a6d76")
    assert main(["markers", "store", "--log", str(folder), "--out", str(tmp_path / "store.json")]) == 0
    stored = load_store(tmp_path / "store.json").markers
    placed = markers_of(load_log(folder))
    assert sorted(stored) == sorted(placed.marker_id.tolist())
    assert len(stored) > 3
    for marker in stored.values():
        # The road lies some 3 m below the marker's middle, whatever its height above the sea.
        assert np.median(marker.lanes[..., 1]) == pytest.approx(-3.0, abs=2.0)
