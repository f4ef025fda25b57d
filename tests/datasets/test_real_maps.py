"""The built-in world on recorded maps as a dataset: splits by log, shares of generated roads, cache keys, real logs."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from tests.datasets.small_argoverse2 import write_log
from tests.datasets.test_geojson_lanes import crossroads_features, write
from tests.datasets.test_nuscenes_scenes import content
from tests.shared import shared_path
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.cache import fingerprint
from tflane_jax.datasets.data_source import Choice
from tflane_jax.datasets.examples import make_example
from tflane_jax.datasets.leaves import example_leaves
from tflane_jax.datasets.marker_observations import markers_of
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.datasets.real_maps import RealMapConfig, RealMapData, RealMapDataset, check_real_maps, sees
from tflane_jax.datasets.recorded_logs import RECORDED_EXAMPLE, RecordedConfig, RecordedData, RecordedDataset
from tflane_jax.datasets.sources import named_source, source_of
from tflane_jax.errors import UserError
from tflane_jax.geometry import invert_pose, project, transform_points
from tflane_jax.limits import SettingError, check_settings
from tflane_jax.markers.simulation import MarkerConfig
from tflane_jax.scene import LineType
from tflane_jax.world.cameras.ring import NUSCENES_RING, CameraRigConfig
from tflane_jax.world.presets import REAL_MAPS
from tflane_jax.world.roads.map_roadside import lane_points
from tflane_jax.world.roads.sd_map import SdMapConfig
from tflane_jax.world.simulate import WorldConfig

SHORT = replace(
    REAL_MAPS,
    traffic=replace(REAL_MAPS.traffic, ego_passes_s=3.0, early_s=30.0),
    duration_s=4.0,
    keyframes=2,
)
GENERATED = WorldConfig(duration_s=4.0, keyframes=2)
EXAMPLE = ExampleConfig(sd_map=SdMapConfig())


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A folder of three maps that differ in nothing but their names."""
    root = tmp_path_factory.mktemp("maps")
    for name in ("north", "south", "west"):
        write(root / f"{name}.geojson", crossroads_features())
    return root


def config(maps, **other):
    return RealMapConfig(maps, scenes=4, world=SHORT, generated_world=GENERATED, example=EXAMPLE, **other)


def test_examples_hold_everything_and_repeat_bit_by_bit(maps):
    dataset = RealMapDataset(config(maps))
    first, again = (example_leaves(one.example(1)) for one in (dataset, RealMapDataset(config(maps))))
    assert len(dataset) == 8
    for name, leaf in first.items():
        np.testing.assert_array_equal(leaf, again[name], err_msg=name)
    example = dataset.example(1)
    assert example.lanes.valid.sum() >= 4
    assert example.traffic_flow.valid.any()
    assert example.sd_map.valid.sum() >= 3
    assert example.has_previous
    info = dataset.info(1)
    assert info.source == "real-maps"
    assert info.scene.rpartition("-")[0] in ("north", "south", "west")


def test_scenes_are_spread_over_all_maps_and_generated_roads(maps):
    dataset = RealMapDataset(config(maps, generated=0.25))
    places = [dataset.place(scene) for scene in range(400)]
    names = [None if place is None else place.name for place in places]
    assert names.count(None) == pytest.approx(100, abs=30)
    for name in ("north", "south", "west"):
        assert names.count(name) == pytest.approx(100, abs=30)


def test_generated_scenes_are_those_of_the_built_in_world(maps):
    ours = RealMapDataset(config(maps, generated=1.0, split="val"))
    world = ProceduralDataset(ProceduralConfig("val", scenes=4, world=GENERATED, example=EXAMPLE))
    for name, leaf in example_leaves(ours.example(2)).items():
        np.testing.assert_array_equal(leaf, example_leaves(world.example(2))[name], err_msg=name)


def test_splits_take_the_logs_that_they_name_and_training_the_others():
    data = RealMapData(Path("x"), val_logs=("a",), test_logs=("b", "c"), generated=0.5)
    train, val, test = (data.source(split) for split in ("train", "val", "test"))
    assert (train.logs, train.without, train.generated) == ((), ("a", "b", "c"), 0.5)
    assert (val.logs, val.without, val.generated) == (("a",), (), 0.0)
    assert (test.logs, test.without) == (("b", "c"), ())
    unnamed = RealMapData(Path("x"), test_logs=("b",)).source("val")
    assert (unnamed.logs, unnamed.without) == ((), ("b",))
    recorded = replace(data, test_on="recordings", test_traffic="a").source("test")
    assert recorded == RecordedConfig(Path("x"), ("b", "c"), traffic="a")
    unnamed = replace(data, test_logs=(), without=("d",), test_on="recordings").source("test")
    assert unnamed == RecordedConfig(Path("x"), (), ("a", "d"))  # not those of the validation
    assert replace(data, without=("d",)).source("train").without == ("a", "b", "c", "d")
    assert source_of(recorded).name == "recorded"
    assert RecordedData(Path("x"), test=("b",)).source("train").without == ("b",)


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("test_on", ["maps", "recordings"])
@pytest.mark.parametrize("name", ["real-maps", "recorded"])
def test_the_data_of_a_split_are_on_its_own_logs(name, test_on, given):
    """Regression: of the test split, the other kind of data was on all logs, those of the training too."""
    data = RealMapData(Path("maps"), val_logs=("b",), test_logs=("c",), without=("d",), test_on=test_on)
    found = named_source(name).choose(Choice("test", given, data.source("test"), Path("maps")))
    assert (found.logs, type(found)) == (("c",), {"real-maps": RealMapConfig, "recorded": RecordedConfig}[name])


def test_the_cache_key_changes_with_the_content_of_the_maps(maps, tmp_path):
    path = write(tmp_path / "town.geojson", crossroads_features())
    before = fingerprint(RealMapDataset(config(tmp_path)))
    assert fingerprint(RealMapDataset(config(tmp_path))) == before
    write(path, crossroads_features()[:-1])
    assert fingerprint(RealMapDataset(config(tmp_path))) != before


def test_a_map_that_was_edited_meanwhile_is_read_again(tmp_path):
    """Regression: examples of the old map were kept under the content of the new one."""

    def dashed():
        segments = RealMapDataset(config(tmp_path)).example(0).segments
        return (np.stack([segments.left_type, segments.right_type])[:, segments.valid] == LineType.DASHED).sum()

    features = crossroads_features()
    path = write(tmp_path / "town.geojson", features)
    assert dashed() > 0
    for feature in features:
        feature["properties"] |= {"left": "solid"} if "left" in feature["properties"] else {}
    write(path, features)
    assert dashed() == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"logs": ("east",)}, "has no log east, only north, south, west"),
        ({"without": ("north", "south", "west")}, "no map of .* is left"),
        ({"generated": 1.5}, "between 0 and 1, not 1.5"),
        ({"scenes": -1}, "has scenes 0 to"),
        ({"generated_world": replace(GENERATED, keyframes=1)}, "give both the same number"),
        ({"maps": Path("nowhere")}, "there is no nowhere"),
    ],
)
def test_impossible_configurations_are_refused(maps, change, message):
    with pytest.raises(UserError, match=message):
        RealMapDataset(dataclasses.replace(config(maps), **change))


def test_traffic_of_another_log_needs_recordings():
    """Regression: on maps the control was ignored, and had the simulated traffic."""
    data = RealMapData(test_logs=("b",), test_traffic="c")
    with pytest.raises(SettingError, match="'' where test_on is not recordings"):
        check_settings(data, "data.")
    check_settings(replace(data, test_on="recordings"), "data.")


def test_the_check_lists_maps_and_faults(maps, tmp_path):
    write(tmp_path / "town.geojson", crossroads_features())
    write(tmp_path / "village.geojson", [])
    found = check_real_maps(tmp_path)
    assert [row["map"] for row in found.rows] == ["town", "village"]
    assert found.rows[0]["intersections"] == 1
    assert found.rows[0]["crossings"] == 1
    (fault,) = found.faults
    assert "village.geojson holds no lane" in fault


def test_recorded_logs_are_no_maps_without_a_recording(maps):
    assert len(RecordedDataset(RecordedConfig(maps))) == 0
    with pytest.raises(UserError, match="a map without a recording"):
        RecordedDataset(RecordedConfig(maps, ("north",)))


def test_the_range_tells_how_far_an_example_sees():
    assert sees(RECORDED_EXAMPLE) == pytest.approx(np.hypot(50.0, 25.0), abs=3.0)


REAL = ("7fab2350-7eaf-3b7e-a39d-6937a4c1bede", "scene-1094")


@pytest.mark.parametrize("name", REAL)
def test_real_maps_become_scenes_with_lanes_of_the_map_and_moving_traffic(name):
    root = shared_path("data")
    dataset = RealMapDataset(RealMapConfig(root, (name,), scenes=1))
    example, log = dataset.example(1), next(iter(dataset.drives()))
    recorded = RecordedDataset(RecordedConfig(root, (name,)))
    lanes = [recorded.example(i).lanes.valid.sum() for i in (0, len(recorded) - 1)]
    assert 0.3 * min(lanes) < example.lanes.valid.sum() < 3.0 * max(lanes)
    assert np.isfinite(log.tracks.position).all()
    assert example.traffic_flow.valid.any(-1).sum() > 3
    assert log.actors.valid[log.keyframes[0].track_frame].sum() > 3


def test_traffic_of_another_log_replaces_the_own_and_nothing_else():
    root, (name, other) = shared_path("data"), REAL
    own = RecordedDataset(RecordedConfig(root, (other,))).example(20)
    swapped = RecordedDataset(RecordedConfig(root, (other,), traffic=name)).example(20)
    giver = RecordedDataset(RecordedConfig(root, (name,)))
    given = giver.example(20 % len(giver))
    for leaf, mine, theirs in zip(
        example_leaves(own), example_leaves(own).values(), example_leaves(swapped).values(), strict=True
    ):
        wanted = example_leaves(given)[leaf] if leaf.startswith("traffic_flow") else mine
        np.testing.assert_array_equal(theirs, wanted, err_msg=leaf)


def test_maps_on_which_nobody_can_drive_are_named(tmp_path):
    pytest.importorskip("pyarrow")
    pytest.importorskip("shapely")
    write_log(tmp_path / "log-a")  # its only lane is for bicycles
    with pytest.raises(UserError, match=r"argoverse2 log-a has no lane open to motor vehicles: .*data\.without"):
        RealMapDataset(config(tmp_path)).example(0)


def test_a_map_of_one_short_lane_gives_a_scene_or_is_named(tmp_path):
    np.savez(tmp_path / "scene-0061.npz", **content())
    example = RealMapDataset(config(tmp_path)).example(0)
    assert example.lanes.valid.sum() == 1
    assert np.isfinite(example.lanes.points[example.lanes.valid]).all()


CAMERA = CameraRigConfig(NUSCENES_RING[:1], scale=0.2, jitter=0.0, severity=0.0, markers=True)


@pytest.mark.parametrize("name", ["", *(pytest.param(name, marks=pytest.mark.slow) for name in REAL)])
def test_markers_and_cameras_work_on_recorded_maps(name, maps):
    """Boards stand beside the map's lanes, are detected there with lanes of the map, and are drawn where they stand."""
    pytest.importorskip("cv2")
    markers = MarkerConfig(markers=8, lanes=96)  # recorded roads are dense
    example = ExampleConfig(sensor=None, cameras=CAMERA, markers=markers)
    source = RealMapConfig(shared_path("data"), (name,), scenes=8) if name else config(maps)
    dataset, blank = RealMapDataset(replace(source, example=example)), replace(CAMERA, markers=False)
    detected = drawn = 0
    for scene in range(dataset.config.scenes):
        log = dataset.simulated(scene)
        placed, road = markers_of(log), KDTree(lane_points(log.map.segments.values()))
        assert len(placed.marker_id) > 0
        assert road.query(placed.pose[:, :2, 3])[0].min() > 1.0
        for number, moment in enumerate(log.keyframes):
            one = make_example(log, number, example)
            found = one.markers
            for row in np.flatnonzero(found.valid):
                ego_from_marker = (
                    invert_pose(moment.global_from_ego) @ placed.pose[placed.marker_id == found.marker_id[row]][0]
                )
                apart = np.linalg.norm(found.pose[row, :3, 3] - ego_from_marker[:3, 3])
                lanes = found.lanes[row][found.lane_valid[row]].reshape(-1, 3).astype(np.float64)
                beside = road.query(transform_points(moment.global_from_ego, lanes)[:, :2])[0]
                assert np.median(beside) < apart + 1.0, "stored lanes move with the marker"
                detected += 1
                pixel, depth, _ = project(
                    ego_from_marker[None, :3, 3], one.cameras.intrinsics[0], one.cameras.camera_from_ego[0]
                )
                width, height = one.cameras.size[0]
                if not (3.0 < depth[0] < 25.0 and 20 < pixel[0, 0] < width - 20 and 20 < pixel[0, 1] < height - 20):
                    continue
                without = make_example(log, number, replace(example, cameras=blank))
                changed = (one.cameras.image[0] != without.cameras.image[0]).any(-1)
                side = one.cameras.intrinsics[0, 0, 0] / depth[0]  # of a metre, pixels
                places = np.argwhere(changed)[:, ::-1]
                near = np.linalg.norm(places - pixel[0], axis=-1) < side
                drawn += bool(near.any())
    assert detected >= 2
    assert drawn >= 1
