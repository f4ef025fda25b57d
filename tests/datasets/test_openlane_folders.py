"""Folders of OpenLane-V2 as people have them: one subset of two, links, own split files, frames without annotations."""

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tflane_jax.ablations.held_out import load_test_data
from tflane_jax.cli import main
from tflane_jax.config import OpenLaneV2Data, RunConfig, WorldData
from tflane_jax.datasets.data_source import Choice
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_choice import preset_of, subset_of
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.openlane_v2 import SOURCE, OpenLaneV2Config, OpenLaneV2Dataset
from tflane_jax.datasets.sources import check_labelled
from tflane_jax.datasets.view_images import TOPONET_SUBSET_A, TOPONET_SUBSET_B
from tflane_jax.errors import UserError
from tflane_jax.files.openlane import info_files
from tflane_jax.geometry import PerceptionRange
from tflane_jax.limits import SettingError, check_settings
from tflane_jax.models.lanesegnet import LaneSegNetConfig
from tflane_jax.models.maptr import MapTrConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.run_checks import check_run
from tflane_jax.scoring.protocols import find_protocol
from tflane_jax.scoring.score import score
from tflane_jax.world.cameras.ring import CameraRigConfig

cv2 = pytest.importorskip("cv2")
SPLIT_FILE = {subset: f"data_dict_subset_{subset}.json" for subset in "AB"}


@pytest.fixture(scope="module", params=["B", "A"])
def whole(request, tmp_path_factory):
    """Two scenes of a subset, as the splits train and val."""
    drives = DriveDataset(DriveConfig(scenes=1, cameras={"B": 6, "A": 7}[request.param]))
    out = tmp_path_factory.mktemp("openlane") / request.param
    return export_openlane_v2({"train": drives, "val": drives}, out, progress=False)


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / whole.name)


def with_other_split_file(folder):
    """Lay the split file of the other subset beside that of the folder's, as the official repository does."""
    path = folder / SPLIT_FILE["B" if folder.name == "A" else "A"]
    path.write_text(json.dumps({"train": {"00777": ["5.json", "6.json"]}, "val": {}, "test": {"21000": ["7.json"]}}))
    return path


def edited(folder, split, **values):
    for path in (folder / split).glob("*/info/*.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | values))


def submission(folder, frames):
    """Write a submission without lanes for some frames (split, segment, timestamp)."""
    record = {"lane_centerline": [], "traffic_element": [], "topology_lclc": [], "topology_lcte": []}
    path = folder.parent / "submission.pkl"
    path.write_bytes(pickle.dumps({"results": {frame: {"predictions": record} for frame in frames}}))
    return path


def frames_of(folder, split="val"):
    files = sorted((folder / split).glob("*/info/*[0-9].json"))
    return [(split, path.parent.parent.name, path.stem) for path in files]


def scored(predictions, truth):
    protocol = find_protocol("openlane-v2.1-centerline")
    return score(*protocol.read(predictions, truth), protocol.metrics, protocol.scene_of, progress=False)


def test_the_split_file_of_a_subset_that_is_not_there_is_no_fault(folder):
    before = check_openlane_v2(folder, progress=False)
    other = with_other_split_file(folder)
    for name in ("openlanev2.md5", "preprocess.py", "preprocess-ls.py"):
        (folder / name).write_text("")
    found = check_openlane_v2(folder, progress=False)
    assert (found.rows, found.faults) == (before.rows, [])
    assert found.skipped == [f"{other}: none of its 3 frames are here"]
    assert subset_of(folder) == folder.name


def test_frames_of_a_split_file_that_are_not_there_are_faults(folder):
    shutil.rmtree(folder / "val")
    found = check_openlane_v2(folder, progress=False)
    (row,) = [row for row in found.rows if row["split"] == "val"]
    assert (row["segments"], row["frames"]) == (0, 0)
    assert f"{FRAMES} of {FRAMES} val frames that split files name are missing" in found.faults[0]


def test_without_a_split_file_the_frames_tell_the_subset(folder):
    (folder / SPLIT_FILE[folder.name]).unlink()
    assert subset_of(folder) == folder.name
    shutil.rmtree(folder / "train")
    assert subset_of(folder) == folder.name
    shutil.rmtree(folder / "val")
    assert subset_of(folder) == "A"


def test_images_of_another_size_keep_all_their_rows(whole):
    preset = TOPONET_SUBSET_A if whole.name == "A" else TOPONET_SUBSET_B
    image = preset_of(whole, "train", subset_of(whole))
    assert (image.front_rows, image.scale) == (None, preset.scale)
    assert preset_of(whole / "nothing", "train", subset_of(whole)) == preset
    choice = Choice("train", True, WorldData().source("train"), whole)
    assert OpenLaneV2Dataset(SOURCE.choose(choice)).example(0).cameras is not None


@pytest.mark.parametrize(
    ("truth", "lanes", "segments"),
    [
        (TopoNetConfig.truth, True, False),
        (LaneSegNetConfig.truth, False, True),
        (MapTrConfig.truth, False, True),
        (("lanes", "segments"), True, True),
    ],
)
def test_a_model_from_other_data_gets_the_truth_that_it_predicts(whole, truth, lanes, segments):
    """Regression: models of segments and of vector maps were scored against no lane at all."""
    chosen = SOURCE.choose(Choice("train", True, WorldData().source("train"), whole, truth=truth))
    example = OpenLaneV2Dataset(replace(chosen, image=None)).example(0)
    assert (example.lanes.valid.any(), example.segments.valid.any()) == (lanes, segments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"range": PerceptionRange((-30.0, 30.0), (-15.0, 15.0))}, r"example.range .*labels are not cut to it"),
        ({"bike_lanes": "exclude"}, "labels do not tell bicycle lanes"),
        ({"cameras": CameraRigConfig()}, "`image` says how the files' images are read"),
    ],
)
def test_settings_that_labels_do_not_follow_are_refused(changes, message):
    """Regression: they were ignored, so that a model learned lanes outside of its box."""
    data = OpenLaneV2Data(Path("x"))
    check_settings(data, "data.")
    with pytest.raises(SettingError, match=message):
        check_settings(replace(data, example=replace(data.example, **changes)), "data.")


def test_links_are_followed(whole, tmp_path):
    linked = tmp_path / "linked"
    for split in ("train", "val"):
        (linked / split).mkdir(parents=True)
        for segment in (whole / split).iterdir():
            (linked / split / segment.name).symlink_to(segment)
    (linked / "loop").symlink_to(linked)
    assert len(list(info_files(linked))) == 4 * FRAMES
    predictions = submission(linked, frames_of(whole))
    scored(predictions, linked)
    assert main(["data", "overlap", str(linked / "train"), str(linked / "val")]) == 0


def test_an_own_split_file_may_be_scored(folder):
    """It names other frames than the official one beside it."""
    frames = frames_of(folder)
    part = {"val": {frames[0][1]: [f"{frames[0][2]}.json"]}}
    predictions = submission(folder, frames[:1])
    with pytest.raises(UserError, match="2 of 3 frames are missing from the predictions"):
        scored(predictions, folder)
    (folder / "data_dict_first.json").write_text(json.dumps(part))
    assert scored(predictions, folder)
    predictions = submission(folder, frames[1:])
    with pytest.raises(UserError, match="1 of 3 frames are missing from the predictions"):
        scored(predictions, folder)


def test_frames_without_annotation_are_none_without_lanes(folder):
    edited(folder, "val", annotation=None)
    source = OpenLaneV2Config(folder, split="val", subset=subset_of(folder), image=None)
    with pytest.raises(UserError, match=r"\.json has no annotation: of the splits, only test may have such frames"):
        OpenLaneV2Dataset(source).example(0)
    with pytest.raises(UserError, match="has no annotation: that of the official test split is not public"):
        scored(submission(folder, frames_of(folder)), folder)


def test_nothing_is_trained_on_or_scored_by_the_official_test_split(folder):
    shutil.copytree(folder / "val", folder / "test")
    (folder / SPLIT_FILE[folder.name]).unlink()
    image = preset_of(folder, "train", subset_of(folder))
    data = OpenLaneV2Data(folder, subset=subset_of(folder), val="test", test="test", image=image)
    check_labelled(data.source("val"), "validation")  # an export keeps its annotations
    edited(folder, "test", annotation=None)
    assert not OpenLaneV2Dataset(data.source("test")).example(0).lanes.valid.any()
    check_labelled(data.source("train"), "training")
    for why, run in (
        ("an evaluation", lambda: check_labelled(data.source("test"), "an evaluation")),
        ("validation", lambda: check_run(RunConfig(data=data))),
        ("an evaluation", lambda: load_test_data(RunConfig(data=data))),
    ):
        with pytest.raises(UserError, match=rf"{why} needs truth: .*\.json has no annotation, as the official test"):
            run()
