"""Traffic flow of OpenLane-V2's frames: the built-in world written in both layouts, and read again."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.datasets.nuscenes_small import PITCH, START, write_nuscenes
from tests.datasets.small_logs import drive, lane_map, log, segment, tracks
from tests.models.cases import CAMERA_TOPONET, SEGMENTS, WITH_TRAFFIC
from tests.shared import shared_path
from tflane_jax.cli import main
from tflane_jax.config import OpenLaneV2Data, RunConfig
from tflane_jax.datasets.argoverse2_export import export_tracks
from tflane_jax.datasets.argoverse2_log import ANNOTATIONS, load_log
from tflane_jax.datasets.argoverse2_poses import POSES
from tflane_jax.datasets.base import ExampleConfig, MissingTracksWarning
from tflane_jax.datasets.nuscenes_export import _sample_frames, export_scenes
from tflane_jax.datasets.openlane_check import check_openlane_v2
from tflane_jax.datasets.openlane_tracks import SourceTracks
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config, OpenLaneV2Dataset, nominal_example
from tflane_jax.datasets.procedural import ProceduralConfig, ProceduralDataset
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.datasets.view_images import ImageConfig
from tflane_jax.errors import UserError
from tflane_jax.files.openlane import FrameKey
from tflane_jax.geometry import yaw_pose
from tflane_jax.losses.lanesegnet import LaneSegNetLossConfig
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig
from tflane_jax.runs import open_run, train_run
from tflane_jax.scene import shapes_of
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig
from tflane_jax.world.cameras.ring import ARGOVERSE2_RING, NUSCENES_RING, CameraRigConfig
from tflane_jax.world.simulate import WorldConfig

feather = pytest.importorskip("pyarrow.feather")
pa = pytest.importorskip("pyarrow")

RIG = CameraRigConfig(ARGOVERSE2_RING, scale=0.02, multiple=16)
EXAMPLE = ExampleConfig(sensor=None, cameras=RIG, history=6, history_hz=5.0)
WORLD = ProceduralConfig("val", scenes=2, world=WorldConfig(keyframes=2), example=EXAMPLE)


# Six cameras, as subset B has them, and boxes at nuScenes' 2 Hz.
EXAMPLE_B = replace(EXAMPLE, cameras=CameraRigConfig(NUSCENES_RING, scale=0.04), history=4, history_hz=2.0)
WORLD_B = replace(WORLD, scenes=1, example=EXAMPLE_B)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return export(tmp_path_factory.mktemp("export"), "WORLD")


@pytest.fixture(scope="module")
def written_b(tmp_path_factory):
    return export(tmp_path_factory.mktemp("export"), "WORLD_B")


def export(root, name):
    """Return the folders of frames and tracks of a world, as one command writes them."""
    config = root / "world.py"
    config.write_text(
        f"from tests.datasets.test_openlane_tracks import {name} as WORLD\n"
        "from tflane_jax.config import RunConfig, WorldData\n"
        "def get_config():\n"
        "    return RunConfig(data=WorldData(val=WORLD.scenes, world=WORLD.world, example=WORLD.example))\n"
    )
    frames, tracks = root / "frames", root / "tracks"
    arguments = ["data", "export", "--config", str(config), "--splits", "val", "--out", str(frames)]
    assert main([*arguments, "--tracks", str(tracks)]) == 0
    return frames, tracks


def opened(frames, tracks, **other) -> OpenLaneV2Dataset:
    return OpenLaneV2Dataset(
        OpenLaneV2Config(frames, "val", image=None, **{"example": EXAMPLE, "tracks": tracks} | other)
    )


def by_place(flow):
    """Return the instances of a traffic flow, in the order of their positions."""
    rows = np.flatnonzero(flow.valid.any(-1))
    masked = np.where(flow.valid[rows, :, None], flow.position[rows], 0.0)
    order = rows[np.lexsort(masked.sum(1).round(2).T)]
    return [np.asarray(leaf)[order] for leaf in (flow.valid, flow.position, flow.yaw, flow.size, flow.category)]


@pytest.mark.parametrize(("subset", "index"), [("A", 0), ("A", 3), ("B", 1)])
def test_frames_get_the_tracks_that_they_had(subset, index, request):
    if subset == "A":
        made, read = ProceduralDataset(WORLD).example(index), opened(*request.getfixturevalue("written")).example(index)
    else:
        folders = request.getfixturevalue("written_b")
        made = ProceduralDataset(WORLD_B).example(index)
        read = opened(*folders, subset="B", example=EXAMPLE_B).example(index)
    read.validate()
    expected, got = by_place(made.traffic_flow), by_place(read.traffic_flow)
    assert len(expected[0]) > 5
    np.testing.assert_array_equal(got[0], expected[0])
    valid = expected[0]
    for name, mine, theirs in zip(("position", "yaw"), got[1:3], expected[1:3], strict=True):
        np.testing.assert_allclose(mine[valid], theirs[valid], atol=1e-3, err_msg=name)
    np.testing.assert_allclose(got[3], expected[3], rtol=1e-6)
    np.testing.assert_array_equal(got[4], expected[4])
    assert made.traffic_flow.occluded.sum() == read.traffic_flow.occluded.sum()


def test_samples_are_two_a_second_and_hold_the_key_frames():
    """Regression: with key frames 19 steps apart, every frame of 10 Hz became a sample."""
    moments = [20, 40, 59, 61, 79]
    frames_ = [SimpleNamespace(track_frame=moment) for moment in moments]
    frames = _sample_frames(SimpleNamespace(keyframes=frames_, rate_hz=10.0, timestamps_ns=range(90)))
    assert frames.tolist()[:10] == [0, 5, 10, 15, 20, 25, 30, 35, 40, 44]
    assert frames.tolist()[10:] == [49, 54, 59, 61, 64, 69, 74, 79, 84, 89]


@pytest.mark.parametrize("first", [0, 6, 12])
def test_frames_in_which_nobody_is_are_written(tmp_path, first):
    """Also before the first and after the last road user, and where there is none."""
    valid = np.zeros((12, 1), bool)
    valid[first : first + 3] = True
    poses = drive(12, start=(0.0, 0.0), step=1.0, turn=0.0)
    made = log(
        lane_map(segment(1, [(0, 0), (40, 0)])), tracks(np.ones((12, 1, 3)), valid=valid), poses, [(0, poses[0])]
    )
    folder = export_tracks([("val", made)], tmp_path / "out") / "sensor" / "val" / made.name
    read = load_log(folder, with_map=False, keyframes="annotations")
    np.testing.assert_array_equal(read.timestamps_ns, made.timestamps_ns)
    np.testing.assert_array_equal(read.tracks.valid, valid[:, : len(read.tracks.uuid)])
    assert len(read.tracks.uuid) == valid.any()


def test_places_are_told_without_reading_annotations(written, tmp_path):
    expected = opened(*written).info(1)
    frames = Path(shutil.copytree(written[0], tmp_path / "frames"))
    for path in frames.glob("val/*/info/*.json"):
        text = path.read_text()
        path.write_text(text[: text.index('"annotation"')] + "not read")
    found = opened(frames, written[1]).info(1)
    np.testing.assert_array_equal(found.global_from_ego, expected.global_from_ego)
    assert (found.scene, found.timestamp_ns) == (expected.scene, expected.timestamp_ns)


def test_the_source_logs_tell_the_city(written, written_b, tmp_path):
    frames, tracks = written
    assert opened(frames, tracks).info(0).area == ""  # these logs have no maps
    known = Path(shutil.copytree(tracks, tmp_path / "tracks"))
    for folder in known.glob("sensor/*/*"):
        (folder / "map").mkdir()
        (folder / "map" / f"log_map_archive_{folder.name}____PIT_city_1.json").touch()
    assert {opened(frames, known).info(index).area for index in range(4)} == {"PIT"}
    assert opened(frames, None).info(0).area == ""
    assert opened(*written_b, subset="B", example=EXAMPLE_B).info(0).area != ""


def test_frames_are_earlier_ones_at_the_wanted_rate(written):
    """Half the rate: the history is that of every second frame, the latest 0.4 s before."""
    coarse = replace(EXAMPLE, history=3, history_hz=2.5)
    every, half = (opened(*written, example=example).example(1).traffic_flow for example in (EXAMPLE, coarse))
    shown = np.flatnonzero(half.valid.any(-1))
    assert len(shown) > 5
    # Frame i of the coarse history is frame 2 i of the fine one: 6 frames end 0.2 s before, 3 frames 0.4 s before.
    fine = every.position[:, 0::2].round(3)
    known = {tuple(row[f]) for row, v in zip(fine, every.valid[:, 0::2], strict=True) for f in range(3) if v[f]}
    assert {tuple(half.position[k, f].round(3)) for k in shown for f in range(3) if half.valid[k, f]} == known


def test_shapes_are_known_without_data(written, tmp_path):
    frames, tracks = written
    config = opened(frames, tracks).config
    nominal = nominal_example(replace(config, root=tmp_path / "none"))
    assert shapes_of(nominal) == shapes_of(opened(frames, tracks).example(0))
    assert opened(frames, None).example(0).traffic_flow is None


def test_missing_logs_are_named_and_can_be_dropped_or_left_empty(written, tmp_path):
    frames, tracks = written
    fewer = shutil.copytree(tracks, tmp_path / "tracks")
    gone = sorted((fewer / "sensor" / "val").iterdir())[0]
    shutil.rmtree(gone)
    with pytest.raises(UserError, match=rf"lacks 1 of the logs .*{gone.name}.*2 of 4 frames"):
        opened(frames, fewer)
    with pytest.warns(MissingTracksWarning, match=rf"2 of 4 frames are left out .* 1 of their logs \({gone.name}\)"):
        assert len(opened(frames, fewer, without_tracks="drop")) == 2
    with pytest.warns(MissingTracksWarning, match="2 of 4 frames have an empty traffic flow"):
        kept = opened(frames, fewer, without_tracks="empty")
    found = check_openlane_v2(frames, fewer, progress=False)
    assert (found.rows[0]["with log"], found.rows[0]["without log"], found.faults) == (2, 2, [])
    assert f"2 of 4 val frames have no log in {fewer}, so no traffic flow: it lacks {gone.name}" in found.skipped
    assert [bool(kept.example(i).traffic_flow.valid.any()) for i in range(4)] == [False, False, True, True]
    shutil.rmtree(sorted((fewer / "sensor" / "val").iterdir())[0])
    with pytest.raises(UserError, match="holds no Argoverse 2 log"):
        opened(frames, fewer, without_tracks="drop")


@pytest.mark.parametrize("fault", ["elsewhere", "another time"])
def test_a_log_that_does_not_fit_is_refused_and_reported(written, tmp_path, fault):
    frames, tracks = written
    wrong = shutil.copytree(tracks, tmp_path / "tracks")
    folder = sorted((wrong / "sensor" / "val").iterdir())[0]
    for name in (ANNOTATIONS, POSES):
        table = feather.read_table(folder / name).to_pydict()
        if fault == "another time":
            table["timestamp_ns"] = [time + 10**12 for time in table["timestamp_ns"]]
        elif name == POSES:
            table["tx_m"] = [x + 5000.0 for x in table["tx_m"]]
        feather.write_feather(pa.table(table), str(folder / name))
    with pytest.raises(UserError, match=f"does not belong to log {folder.name}"):
        opened(frames, wrong).example(0)
    found = check_openlane_v2(frames, wrong, progress=False)
    assert len(found.faults) == 2
    assert all("does not belong" in text for text in found.faults)
    assert (found.rows[0]["with log"], found.rows[0]["with traffic"]) == (2, "2 (50.0 %)")


def test_the_check_counts_frames_with_traffic(written, capsys):
    frames, tracks = written
    assert main(["data", "check", "--format", "openlane-v2", str(frames), "--tracks", str(tracks)]) == 0
    assert "4 (100.0 %)" in capsys.readouterr().out
    assert main(["data", "check", "--format", "tusimple", str(frames), "--tracks", str(tracks)]) == 2


@pytest.mark.parametrize("source", [None, ..., ""])
def test_a_segment_that_does_not_name_its_log_is_a_fault(written, tmp_path, source):
    """Regression: `data check` found nothing wrong, where training stopped."""
    frames, tracks = Path(shutil.copytree(written[0], tmp_path / "frames")), written[1]
    first = sorted(frames.glob("val/*/info/*[0-9].json"))[0]
    record = json.loads(first.read_text())
    record["meta_data"] |= {"source_id": source}
    if source is ...:
        del record["meta_data"]["source_id"]
    first.write_text(json.dumps(record))
    with pytest.raises(UserError, match="source_id") as error:
        opened(frames, tracks)
    found = check_openlane_v2(frames, tracks, progress=False)
    assert found.faults == [str(error.value)]
    assert (found.rows[0]["with log"], found.rows[0]["without log"], found.skipped) == (2, 2, [])
    first.write_text("damaged")
    assert len(check_openlane_v2(frames, tracks, progress=False).faults) == 1


def test_tracks_are_written_once_and_are_those_of_one_subset(written):
    _, tracks = written
    with pytest.raises(UserError, match="is not empty"):
        export_tracks([], tracks)
    with pytest.raises(UserError, match="holds no nuScenes tables"):
        SourceTracks(tracks, "B", {})
    with pytest.raises(UserError, match="is not empty"):
        export_scenes([], tracks)


@pytest.mark.parametrize("scene", ["scene-0061", "scene-a"])
def test_subset_b_takes_the_tracks_of_nuscenes(tmp_path, scene):
    """A frame 10 ms and 0.1 m after sample 3, from a pitched vehicle; the car of sample 0 was 15 m before it."""
    tracks = SourceTracks(write_nuscenes(tmp_path), "B", {("val", "11000"): scene, ("val", "11001"): "scene-0001"})
    key = FrameKey("val", "11000", str(START + 1_500_000 + 10_000))
    other = FrameKey("val", "11001", key.timestamp)
    with pytest.warns(MissingTracksWarning, match="scene-0001"):
        assert tracks.known([key, other], "drop") == [key]
    with pytest.raises(UserError, match=r"lacks 1 of the logs of these frames \(scene-0001\)"):
        tracks.known([key, other], "refuse")
    pitched = np.array([[np.cos(PITCH), 0, np.sin(PITCH)], [0, 1, 0], [-np.sin(PITCH), 0, np.cos(PITCH)]])
    pose = yaw_pose(400.0, 1115.1, np.pi / 2)
    pose[:3, :3] = pose[:3, :3] @ pitched
    sizes = ExampleConfig(tracks=4, history=5, history_hz=2.0)
    flow = tracks.flow(key, pose, sizes)
    car = int(np.flatnonzero(flow.valid[:, 2])[0])
    assert flow.valid[car].tolist() == [False, False, True, True, False]
    np.testing.assert_allclose(flow.position[car, 2:4], [[-5.1, 3, 1], [-0.1, 3, 1]], atol=1e-5)
    assert not tracks.flow(other, pose, sizes).valid.any()
    with pytest.raises(UserError, match=r"does not belong to log scene-0061: .* 15 m away"):
        tracks.flow(key, yaw_pose(400.0, 1130.0, np.pi / 2), sizes)


@pytest.mark.slow
@pytest.mark.parametrize(("host", "subset"), [("toponet", "A"), ("toponet", "B"), ("lanesegnet", "A")])
def test_a_camera_model_trains_on_frames_with_tracks(tmp_path, host, subset, request):
    """The whole chain: both layouts, workers, prior, camera model, update, evaluation with and without traffic."""
    frames, tracks = request.getfixturevalue("written" if subset == "A" else "written_b")
    flavour, weights, score, small, example = (
        "centerline",
        TopoNetLossConfig(),
        "DET_l",
        CAMERA_TOPONET,
        EXAMPLE if subset == "A" else EXAMPLE_B,
    )
    if host == "lanesegnet":
        flavour, weights, score = "lane_segment", LaneSegNetLossConfig(), "mAP"
        decoder = replace(SEGMENTS.decoder, points=EXAMPLE.segment_points)
        small = replace(SEGMENTS, encoder=CAMERA_TOPONET.encoder, decoder=decoder)
        example = replace(EXAMPLE, crossings="sides")
    loading = StreamingConfig(threads=1, ahead=2)
    image = ImageConfig(divisor=16)
    data = OpenLaneV2Data(
        frames,
        "val",
        subset=subset,
        flavour=flavour,
        example=replace(example, cameras=None),  # images are those of the files
        image=image,
        loading=loading,
        tracks=tracks,
        augmentation=None,
    )
    traffic = replace(
        WITH_TRAFFIC.priors.traffic_flow, prior=TrafficFlowPriorConfig(frames=example.history, min_valid_frames=2)
    )
    encoder = replace(
        CAMERA_TOPONET.encoder, bev=replace(CAMERA_TOPONET.encoder.bev, cameras=len(example.cameras.cameras))
    )
    model = replace(small, encoder=encoder, priors=PriorsConfig(traffic_flow=traffic))
    training = TrainingConfig(steps=2, batch_size=2, eval_every=2, best_metric=f"all/{score}")
    run = RunConfig(LaneGraphTask(model, weights), data, OptimConfig(warmup_steps=0), training)
    result = train_run(run, tmp_path / "run", progress=False)
    assert result.step == 2
    flows = {name: replace(run.evaluation, traffic=name) for name in ("own", "none")}
    trained = open_run(tmp_path / "run", "last")
    examples = run.task.load(data.source("val"), progress=False)
    answers = {name: run.task.evaluate(trained.params[0], examples, config) for name, config in flows.items()}
    assert all(np.isfinite(answer.groups["all"][score]) for answer in answers.values())


def test_a_real_log_and_the_frames_of_its_segment():
    """Frames with the log's own poses at OpenLane-V2's front-camera times, which are those of no box."""
    root, table = shared_path("data/argoverse2"), shared_path("data/openlanev2")
    split = json.loads((table / "OpenLane-V2" / "data_dict_av2_local.json").read_text())["val"]
    (segment, names), name = next(iter(split.items())), "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
    log = load_log(next(root.rglob(name)), openlane=table)
    tracks = SourceTracks(root, "A", {("val", segment): name})
    sizes = ExampleConfig(tracks=96)
    counts = []
    for moment in log.keyframes:
        key = FrameKey("val", segment, str(moment.timestamp_ns))
        assert f"{moment.timestamp_ns}.json" in names
        flow = tracks.flow(key, moment.global_from_ego, sizes)
        assert np.isfinite(flow.position).all()
        near = (np.abs(flow.position[..., 0]) < 50.0) & (np.abs(flow.position[..., 1]) < 25.0) & flow.valid
        counts.append((near.any(-1).sum(), (near.sum(-1) >= 5).sum()))
    assert counts[0] == (0, 0)  # the first frame has no past
    # Road users without street furniture; with it, the data's notes count 30.2 and 29.2 on average.
    assert 25.0 < np.mean(counts, 0)[1] <= np.mean(counts, 0)[0] < 30.2
