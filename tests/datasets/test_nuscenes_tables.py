"""The tables of nuScenes: joined by hand-made values, and every kind of damage named with file and row."""

import json

import pytest

from tests.datasets.nuscenes_small import START, tables, write_nuscenes
from tests.datasets.test_nuscenes import write_images
from tflane_jax.datasets.nuscenes import SOURCE, NuScenesConfig
from tflane_jax.datasets.nuscenes_check import check_nuscenes
from tflane_jax.datasets.nuscenes_folder import find_tables
from tflane_jax.datasets.nuscenes_log import scene_frames, scene_tracks
from tflane_jax.datasets.nuscenes_place import scene_files
from tflane_jax.datasets.nuscenes_splits import MINI_TRAIN, MINI_VAL, TEST, VAL, official_split, split_scenes
from tflane_jax.datasets.nuscenes_tables import TABLES, read_tables
from tflane_jax.errors import UserError


def test_thirteen_tables_are_joined(tmp_path):
    assert len(TABLES) == 13
    found = read_tables(find_tables(write_nuscenes(tmp_path)))
    assert found.root == tmp_path
    assert found.mini
    assert sorted(found.scenes()) == ["scene-0061", "scene-0103"]
    scene = found.scenes()["scene-0061"]
    assert found.location(scene) == "singapore-onenorth"
    samples = found.samples(scene)
    assert [sample["timestamp"] for sample in samples] == [START + 500_000 * i for i in range(4)]
    # sample.data and sample.anns are not in the files; sweeps between key frames are left out.
    assert sorted(found.data["sample-a2"]) == ["CAM_FRONT", "LIDAR_TOP"]
    assert found.data["sample-a2"]["LIDAR_TOP"]["token"] == "data-a2-LIDAR_TOP-0"
    assert sorted(row["token"] for row in found.annotations["sample-a1"]) == ["car-1", "walker"]
    assert "sample-b0" not in found.annotations
    # Only the poses that key frames name are kept.
    assert len(found.rows["ego_pose"]) == 12
    assert found.ego_pose(samples[1], "CAM_FRONT")[:3, 3].tolist() == [400.0, 1105.4, 0.0]
    assert found.ego_pose(samples[1])[:3, 3].tolist() == [400.0, 1105.0, 0.0]


def test_null_counts_as_no_neighbour(tmp_path):
    """t4-devkit, which writes this schema, has null in place of ""."""
    content = tables()
    for row in [*content["sample"], *content["sample_annotation"]]:
        for column in ("prev", "next", "visibility_token"):
            if row.get(column) == "":
                row[column] = None
    found = read_tables(find_tables(write_nuscenes(tmp_path, content)))
    assert len(found.samples(found.scenes()["scene-0103"])) == 2


def change(table, number, **columns):
    """Return damage that overwrites columns of one row; ... removes the column."""

    def damage(content):
        row = content[table][number]
        for column, value in columns.items():
            if value is ...:
                del row[column]
            else:
                row[column] = value

    return damage


def repeat(table, number=0, **columns):
    """Return damage that appends a copy of a row with other columns."""
    return lambda content: content[table].append(content[table][number] | columns)


def timed(scale):
    """Return damage that writes the times of all samples in another unit."""

    def damage(content):
        for row in content["sample"]:
            row["timestamp"] = scale(row["timestamp"])

    return damage


NAN, ZERO = float("nan"), [0.0] * 4
DAMAGE = {
    "row without token": (change("log", 0, token=...), r"log\.json: row number 0 has no token"),
    "row that is no record": (lambda c: c["log"].append(3), r"log\.json: row number 2 has no token"),
    "two rows with one token": (repeat("category"), r"category\.json: two rows have the token is-"),
    "column missing": (change("sample", 2, next=...), r"sample\.json: row sample-a2 lacks the column next"),
    "number instead of text": (change("scene", 0, name=7), r"scene\.json: row scene-b: name is 7, expected text"),
    "text instead of a number": (
        change("sample", 0, timestamp="now"),
        r"sample\.json: row sample-a0: timestamp is 'now', expected a whole number",
    ),
    "fraction of a point": (change("sample_annotation", 0, num_lidar_pts=0.5), "car-3: num_lidar_pts is 0.5"),
    "negative points": (change("sample_annotation", 0, num_radar_pts=-1), "car-3: num_radar_pts is -1"),
    "key frame that is neither": (change("sample_data", 0, is_key_frame=1), "is_key_frame is 1, expected true or"),
    "unknown sample": (
        change("sample_annotation", 0, sample_token="gone"),
        r"sample_annotation\.json: row car-3: sample_token is 'gone', which sample\.json does not have",
    ),
    "unknown instance": (change("sample_annotation", 0, instance_token="gone"), r"instance\.json does not have"),
    "unknown visibility": (change("sample_annotation", 0, visibility_token="9"), r"visibility\.json does not have"),
    "unknown category": (change("instance", 0, category_token="gone"), r"category\.json does not have"),
    "unknown pose": (change("sample_data", 0, ego_pose_token="gone"), r"ego_pose\.json does not have"),
    "unknown calibration": (
        change("sample_data", 0, calibrated_sensor_token="gone"),
        r"calibrated_sensor\.json does not have",
    ),
    "unknown sensor": (change("calibrated_sensor", 0, sensor_token=""), r"sensor\.json does not have"),
    "unknown log": (change("scene", 0, log_token="gone"), r"scene\.json: row scene-b: log_token is 'gone', which log"),
    "unknown next": (change("sample", 0, next="gone"), r"sample\.json: row sample-a0: next is 'gone'"),
    "unknown first sample": (change("scene", 1, first_sample_token="gone"), "first_sample_token is 'gone'"),
    "circle": (
        lambda c: [change("sample", 3, next="sample-a0")(c), change("sample", 0, prev="sample-a3")(c)],
        r"sample\.json: row sample-a0: next comes back",
    ),
    "next in another scene": (
        change("sample", 3, next="sample-b0"),
        "row sample-b0: it is in the chain of scene scene-0061, but its scene_token differs",
    ),
    "prev that disagrees": (change("sample", 2, prev="sample-a0"), "row sample-a2: prev is not the sample whose next"),
    "time that runs back": (change("sample", 2, timestamp=START), "row sample-a2: its timestamp is not later"),
    "times in nanoseconds": (
        timed(lambda time: 1000 * time),
        r"scene\.json: row scene-b: a sample has the time 1532402927500000000: expected microseconds",
    ),
    "nanoseconds from the start": (
        timed(lambda time: 1000 * (time - START)),
        r"row scene-b: its frames are 5e\+02 s apart: are its times in microseconds",
    ),
    "times in milliseconds": (timed(lambda time: time // 1000), r"frames are 0\.0005 s apart: are its times in micro"),
    "chain cut short": (change("sample", 1, next=""), r"scene\.json: row scene-a: the chain of samples has 2 and ends"),
    "number of samples": (change("scene", 1, nbr_samples=5), "the chain of samples has 4"),
    "two scenes with one name": (change("scene", 0, name="scene-0061"), "a second scene is called scene-0061"),
    "no lidar": (
        lambda c: c["sample_data"].pop(0),
        r"sample_data\.json: sample sample-a0 has no key frame of LIDAR_TOP",
    ),
    "second key frame of a channel": (
        repeat("sample_data", token="other"),
        "row other: sample sample-a0 has a second key frame of LIDAR_TOP",
    ),
    "NaN in an ego pose": (
        change("ego_pose", 0, translation=[NAN, 0.0, 0.0]),
        r"ego_pose\.json: row pose-a0-LIDAR_TOP-0: translation holds nan",
    ),
    "NaN quaternion": (change("ego_pose", 0, rotation=[NAN] * 4), "row pose-a0-LIDAR_TOP-0: rotation holds nan"),
    "zero quaternion": (change("ego_pose", 0, rotation=ZERO), r"row pose-a0-LIDAR_TOP-0: rotation .* no unit quater"),
    "quaternion of three": (change("ego_pose", 0, rotation=[1, 0, 0]), r"rotation has shape \(3,\), expected \(4,\)"),
    "pose as text": (change("ego_pose", 0, translation="here"), "translation is of type str, expected numbers"),
    "digits as text": (change("ego_pose", 0, translation=["1", "2", "3"]), "translation is of type list, expected num"),
    "vehicle that jumps": (
        change("ego_pose", 3, translation=[400.0, 6105.0, 0.0]),
        r"sample\.json: row sample-a1: the vehicle is 5005 m from its place 0.5 s before",
    ),
    "box far away": (
        change("sample_annotation", 1, translation=[397.0, 6110.0, 1.0]),
        r"sample_annotation\.json: row car-0: the box is 5010 m from the vehicle",
    ),
    "NaN in a box": (
        change("sample_annotation", 1, translation=[0.0, NAN, 0.0]),
        r"sample_annotation\.json: row car-0: translation holds nan",
    ),
    "zero quaternion of a box": (change("sample_annotation", 1, rotation=ZERO), "row car-0: rotation .* no unit quat"),
    "negative size": (change("sample_annotation", 1, size=[2.0, -4.0, 1.0]), r"row car-0: size \[2.0, -4.0, 1.0\]"),
    "size of two": (change("sample_annotation", 1, size=[2.0, 4.0]), r"row car-0: size has shape \(2,\)"),
    "category nobody knows": (
        change("category", 0, name="hovercraft"),
        "unknown category 'hovercraft': name it below a known one there, such as vehicle.car.hovercraft, or add it to",
    ),
    "vehicle nobody knows": (change("category", 0, name="vehicle.hovercraft"), "unknown category 'vehicle.hovercraft'"),
    "instance twice in a sample": (
        repeat("sample_annotation", token="again"),
        "instance car has 2 boxes in sample sample-a3",
    ),
    "more points than 64 bits": (
        change("sample_annotation", 1, num_lidar_pts=10**30),
        r"row car-0: num_lidar_pts is an integer of many digits, expected a whole number",
    ),
    "sum of points of more than 64 bits": (
        change("sample_annotation", 1, num_lidar_pts=2**62, num_radar_pts=2**62),
        r"row car-0: num_lidar_pts is 4611686018427387904, expected a whole number",
    ),
    "visibility nobody knows": (change("visibility", 3, level="v101"), "unknown visibility level 'v101'"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_with_file_and_row(tmp_path, name):
    damage, message = DAMAGE[name]
    content = tables()
    damage(content)
    with pytest.raises(UserError, match=message):
        read_everything(write_nuscenes(tmp_path, content))


def read_everything(root):
    found = read_tables(find_tables(root))
    return {name: scene_tracks(found, scene_frames(found, scene)) for name, scene in found.scenes().items()}


@pytest.mark.parametrize("table", TABLES)
def test_every_table_must_be_there_and_be_a_list(tmp_path, table):
    root = write_nuscenes(tmp_path)
    path = root / "v1.0-mini" / f"{table}.json"
    text = path.read_text()
    for damaged in (text[: len(text) // 2], json.dumps({"token": "x"})):
        path.write_text(damaged)
        with pytest.raises(UserError, match=rf"{table}\.json is no JSON"):
            read_tables(root / "v1.0-mini")
    path.unlink()
    with pytest.raises(UserError, match=rf"v1\.0-mini lacks 1 of nuScenes' 13 tables \({table}\.json\): unpack"):
        read_tables(root / "v1.0-mini")


def test_the_official_splits():
    assert (len(VAL), len(TEST), len(MINI_TRAIN), len(MINI_VAL)) == (150, 150, 8, 2)
    assert not VAL & TEST
    assert MINI_VAL <= VAL
    assert {"scene-0553", "scene-0796"} == MINI_TRAIN & VAL
    for name, full, mini in (
        ("scene-0061", "train", "train"),
        ("scene-0553", "val", "train"),
        ("scene-0103", "val", "val"),
        ("scene-0077", "test", None),
        ("scene-1110", "train", None),
    ):
        assert (official_split(name, mini=False), official_split(name, mini=True)) == (full, mini)


def test_scenes_that_do_not_fit_the_map_may_be_left_out(tmp_path):
    names = ["scene-0499", "scene-0500", "scene-0501", "scene-0502", "scene-0515", "scene-0517", "scene-0518"]
    assert split_scenes(names, "train", mini=False) == names
    assert split_scenes(names, "train", mini=False, misplaced="drop") == ["scene-0500", "scene-0518"]
    file = tmp_path / "splits.json"
    file.write_text(json.dumps({"train": names[:2]}))
    assert split_scenes(names, "train", mini=False, file=file, misplaced="drop") == ["scene-0500"]


def test_splits_of_a_users_own(tmp_path):
    names, file = ["scene-0103", "scene-0061"], tmp_path / "splits.json"
    assert split_scenes(names, "train", mini=True) == ["scene-0061"]
    with pytest.raises(UserError, match=r"split test has no scene .* train \(1 scenes\), val \(1 scenes\)"):
        split_scenes(names, "test", mini=True)
    file.write_text(json.dumps({"train": names, "val": [], "test": ["scene-0001"]}))
    assert split_scenes(names, "train", mini=True, file=file) == sorted(names)
    with pytest.raises(UserError, match="names scene-0001, which the tables do not have"):
        split_scenes(names, "test", mini=True, file=file)
    with pytest.raises(UserError, match="split val has no scene"):
        split_scenes(names, "val", mini=True, file=file)
    for wrong in ({"train": "scene-0061"}, {"train": [1]}, {"train": ["a", "a"]}, {}):
        file.write_text(json.dumps(wrong))
        with pytest.raises(UserError, match=r"splits\.json"):
            split_scenes(names, "train", mini=True, file=file)


def test_tables_without_a_scene_are_a_fault(tmp_path):
    """Regression: `data check` found nothing wrong with an empty table."""
    content = {name: rows if name == "category" else [] for name, rows in tables().items()}
    found = check_nuscenes(write_nuscenes(tmp_path, content))
    assert found.rows == []
    assert [fault.partition("scene.json ")[2] for fault in found.faults] == ["holds no scene: unpack the tables again"]


def test_a_folder_of_tables_and_maps_alone_is_sound(tmp_path):
    """Regression: every scene was a fault, though models that see no images need none."""
    found = check_nuscenes(write_nuscenes(tmp_path))
    assert (found.faults, [row["missing images"] for row in found.rows]) == ([], [0, 0])
    assert found.skipped == [f"images were not looked for: there is no {tmp_path / 'samples'}"]
    (tmp_path / "samples").mkdir()
    assert [fault.partition(" image")[0] for fault in check_nuscenes(tmp_path).faults] == [
        "scene-0061 lacks 4",
        "scene-0103 lacks 2",
    ]


def test_a_place_is_a_plain_name(tmp_path):
    """It names the file of its map."""
    content = tables()
    content["log"][0]["location"] = "../secret"
    root = write_nuscenes(tmp_path, content)
    found = read_tables(root / "v1.0-mini")
    with pytest.raises(UserError, match=r"row log-a: location is '\.\./secret', expected a name that can be"):
        found.location(found.scenes()["scene-0061"])
    with pytest.raises(UserError, match=r"location is '\.\./secret', expected a name that can be"):
        list(scene_files(root / "v1.0-mini" / "scene.json"))


def test_a_scene_is_not_trained_on_and_tested(tmp_path):
    file = tmp_path / "splits.json"
    names = ["scene-0061", "scene-0103"]
    file.write_text(json.dumps({"train": names[:1], "val": names[1:], "test": names[1:]}))
    assert split_scenes(names, "test", mini=True, file=file) == ["scene-0103"]
    file.write_text(json.dumps({"train": names, "val": names[1:]}))
    for split in ("train", "val"):
        with pytest.raises(UserError, match="scene-0103 is in train and in val: give each scene to one of them"):
            split_scenes(names, split, mini=True, file=file)


def test_scores_depend_on_the_scenes_that_a_file_of_splits_names(tmp_path):
    file = tmp_path / "splits.json"
    config, found = NuScenesConfig(tmp_path, split="test", splits=file), []
    for scenes in (["a", "b"], ["b", "a"], ["b"]):
        file.write_text(json.dumps({"test": scenes, "train": ["c"]}))
        found.append(SOURCE.content(config))
    assert found[0] == found[1] != found[2]
    assert SOURCE.content(NuScenesConfig(tmp_path)) == ""


def test_cameras_that_training_would_refuse_are_faults(tmp_path):
    """Regression: images were only looked for, and calibrations not at all."""
    write_images(tmp_path)
    front = tmp_path / "samples" / "CAM_FRONT"
    assert check_nuscenes(write_nuscenes(tmp_path)).faults == []
    (front / "a1.jpg").write_text("no image")
    (front / "a2.jpg").write_bytes((front / "a3.jpg").read_bytes()[:-40])
    write_images(tmp_path / "small", size=(32, 36))
    (tmp_path / "small" / "samples" / "CAM_FRONT" / "b0.jpg").replace(front / "b0.jpg")
    assert check_nuscenes(tmp_path).faults == [
        f"scene-0061: {front / 'a1.jpg'} is damaged or cut short (2 images of the scene)",
        f"scene-0103: {front / 'b0.jpg'} is 32 x 36 pixels, 64 x 36 in the tables",
    ]
    content = tables()
    content["calibrated_sensor"][1]["camera_intrinsic"] = [[0.0] * 3] * 3
    content["sample_data"][4]["width"] = 32
    said = check_nuscenes(write_nuscenes(tmp_path, content)).faults
    assert "images of CAM_FRONT are 32 x 36 pixels here and 64 x 36 before" in said[0]
    assert [fault.partition(":")[0] for fault in said[1:]] == ["scene-0061", "scene-0103"]
    assert all("camera_intrinsic is no camera matrix" in fault for fault in said[1:])
