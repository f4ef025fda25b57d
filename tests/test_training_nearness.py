"""Evaluated frames beside those of the training split: real places, and cities with equal coordinates."""

from dataclasses import replace

import numpy as np
import pytest

from tests.datasets.openlane_scenes import DriveConfig, DriveDataset
from tests.datasets.test_nuscenes_scenes import content
from tests.shared import shared_path
from tflane_jax.config import RealMapData, RecordedData, RunConfig, WorldData
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config
from tflane_jax.errors import UserError
from tflane_jax.training_nearness import training_nearness


def test_test_frames_are_compared_with_the_places_of_the_training_split(tmp_path):
    np.savez(tmp_path / "scene-0061.npz", **content())
    np.savez(tmp_path / "scene-0099.npz", **content("scene-0099"))
    recorded, maps = RecordedData(tmp_path, test=("scene-0099",)), RealMapData(tmp_path, test_logs=("scene-0099",))
    test = recorded.source("test")
    for data in (recorded, maps):
        found = training_nearness(RunConfig(data=data), test)
        assert found is not None
        np.testing.assert_allclose(found.distances, 0.0)  # both files hold the same drive
    assert training_nearness(RunConfig(data=WorldData()), test) is None
    assert training_nearness(RunConfig(data=replace(maps, generated=1.0)), test) is None
    assert training_nearness(RunConfig(data=recorded), WorldData().source("test")) is None


def test_scenes_simulated_on_recorded_maps_are_not_compared():
    """Half of them are mirrored, so that their positions are not those of the recorded drive on the same streets."""
    maps = RealMapData(shared_path("data/nuscenes_scenes"), test=2)
    assert training_nearness(RunConfig(data=maps), maps.source("test")) is None


def test_the_training_split_may_lie_in_another_folder(tmp_path):
    """Of a model that learned elsewhere, or whose configuration names another place: `--training-root`."""
    pytest.importorskip("cv2")
    scenes = DriveDataset(DriveConfig(scenes=1))
    root = export_openlane_v2({"train": scenes, "val": scenes}, tmp_path / "data", progress=False)
    source = OpenLaneV2Config(root, "val", subset="B", image=None)
    found = training_nearness(RunConfig(data=WorldData()), source, root)
    assert found is not None
    assert found.groups == ["near training"] * 3
    assert found.sentence() == (
        "3 of 3 frames are within 5 m of a training frame; the nearest is 0.0 m away. "
        "Files do not name the city of 3 of them, which may be another with equal coordinates"
    )
    with pytest.raises(UserError, match=r"there is no folder .*elsewhere"):
        training_nearness(RunConfig(data=WorldData()), source, tmp_path / "elsewhere")
    with pytest.raises(UserError, match="has no training split in a folder: leave out --training-root"):
        training_nearness(RunConfig(), WorldData().source("test"), root)


def test_the_source_logs_tell_the_city_of_training_frames(tmp_path):
    """Both scenes drive at the same coordinates. The log of a training frame may be missing: its city is not known."""
    pytest.importorskip("cv2")
    one, two = (DriveDataset(DriveConfig(scenes, cameras=7)) for scenes in (1, 2))
    root = export_openlane_v2({"train": one, "val": two}, tmp_path / "data", progress=False)
    turned = export_openlane_v2({"train": two, "val": one}, tmp_path / "turned", progress=False)
    for folder, city in (("both/scene 0", "PIT"), ("both/scene 1", "MIA"), ("first/scene 0", "PIT")):
        (tmp_path / folder / "map").mkdir(parents=True)
        (tmp_path / folder / "map" / f"log_map_archive_x____{city}_city_1.json").touch()
        (tmp_path / folder / ANNOTATIONS).touch()
    source = OpenLaneV2Config(root, "val", subset="A", image=None, tracks=tmp_path / "both")
    found = training_nearness(RunConfig(data=WorldData()), source, root)
    assert found is not None
    assert found.groups == ["near training"] * 3 + ["far from training"] * 3
    assert found.sentence() == "3 of 6 frames are within 5 m of a training frame; the nearest is 0.0 m away"
    source = replace(source, root=turned, tracks=tmp_path / "first")
    found = training_nearness(RunConfig(data=WorldData()), source, turned)
    assert found is not None
    assert found.groups == ["near training"] * 3
