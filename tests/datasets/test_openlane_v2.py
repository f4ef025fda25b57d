"""OpenLane-V2's reader: images and boxes, capacity, errors, training on it, real frames."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.datasets.openlane_scenes import FRAMES, DriveConfig, DriveDataset
from tests.fakes import FakeConfig, FakeDataset
from tests.shared import shared_path
from tflane_jax.cli import build_parser
from tflane_jax.commands.sources import chosen_source
from tflane_jax.config import OpenLaneV2Data, RunConfig
from tflane_jax.datasets.base import ExampleConfig, TruncationWarning
from tflane_jax.datasets.batches import batches
from tflane_jax.datasets.cache import cached
from tflane_jax.datasets.openlane_export import export_openlane_v2
from tflane_jax.datasets.openlane_frames import list_frames
from tflane_jax.datasets.openlane_v2 import OpenLaneV2Config, OpenLaneV2Dataset, nominal_example
from tflane_jax.datasets.photometric import PhotometricConfig
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
from tflane_jax.datasets.view_images import (
    BASELINE_LARGE,
    LANESEGNET_BUCKET,
    TOPONET_SUBSET_A,
    TOPONET_SUBSET_B,
    ImageConfig,
    canvas_size,
    fit_image,
)
from tflane_jax.errors import UserError
from tflane_jax.geometry import project

SIZES = ExampleConfig(lanes=5, segments=4, areas=2, elements=3)
NATIVE = ImageConfig(divisor=16)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("openlane") / "made"
    return export_openlane_v2({"train": DriveDataset(DriveConfig(scenes=1))}, out, images="png", progress=False)


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def opened(root, image=NATIVE, **other) -> OpenLaneV2Dataset:
    return OpenLaneV2Dataset(OpenLaneV2Config(root, image=image, **{"subset": "B", "example": SIZES} | other))


def info(folder, number=0, suffix=""):
    files = sorted((folder / "train" / "01000" / "info").glob("*[0-9].json"))
    return files[number].with_name(files[number].stem + suffix + ".json")


def change(path, function):
    content = json.loads(path.read_text())
    function(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("config", "front", "others", "canvas"),
    [
        (TOPONET_SUBSET_A, (775, 775), (1024, 775), (1024, 800)),
        (LANESEGNET_BUCKET, (511, 511), (675, 511), (704, 512)),
        (BASELINE_LARGE, (2048, 1550), (2048, 1550), (2048, 1568)),
        (TOPONET_SUBSET_B, (800, 450), (800, 450), (800, 480)),
    ],
)
def test_presets_have_the_papers_sizes(config, front, others, canvas):
    sizes = [(1550, 2048), (2048, 1550)] if config is not TOPONET_SUBSET_B else [(1600, 900)] * 2
    fits = [fit_image(*size, config, front=place == 0) for place, size in enumerate(sizes)]
    assert [fit.size for fit in fits] == [front, others]
    assert canvas_size([fit.size for fit in fits], config.divisor) == canvas


@pytest.mark.parametrize(
    "config", [ImageConfig(front_rows=(8, 28), scale=0.5), ImageConfig(front_size=(60, 20)), ImageConfig(scale=0.25)]
)
def test_pixels_intrinsics_and_boxes_move_together(config):
    """A marked pixel, a point projected there and a box around it stay together."""
    fit = fit_image(48, 32, config, front=True)
    image = np.zeros((32, 48, 3), np.uint8)
    image[16:20, 20:24] = 250
    result = fit.image(image)
    assert result.shape[1::-1] == fit.size
    v, u = (
        np.average(np.arange(n) + 0.5, weights=result[..., 0].sum(axis))
        for n, axis in zip(result.shape[:2], (1, 0), strict=True)
    )
    intrinsics = np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
    place = np.array([[(22 - 24) / 40 * 10, (18 - 16) / 40 * 10, 10.0]])  # the middle of the mark, camera frame
    pixel, _, _ = project(place, fit.intrinsics(intrinsics), np.eye(4))
    np.testing.assert_allclose(pixel[0], (u, v), atol=0.05)
    box = fit.boxes(np.array([[[20.0, 16], [24, 20]]]))[0]
    np.testing.assert_allclose(box.mean(0), (u, v), atol=0.05)
    np.testing.assert_allclose(box[1] - box[0], 4 * np.array(fit.scale))


def test_images_in_an_example(whole):
    """The front image loses rows, and with them an element; the rest is halved."""
    example = opened(whole, ImageConfig(front_rows=(6, 32), scale=0.5, divisor=8)).example(0)
    views, made = example.cameras, DriveDataset().example(0)
    assert views.image.shape == (6, 16, 24, 3)
    assert views.size.tolist() == [[24, 13], *[[24, 16]] * 4, [24, 8]]
    block = made.cameras.image[1, :32, :48].reshape(16, 2, 24, 2, 3).mean((1, 3))
    np.testing.assert_allclose(views.image[1], block, atol=1)
    assert not views.image[0, 13:].any()
    np.testing.assert_allclose(
        example.traffic_elements.box[:2], [[[5, 0], [7, 3.25]], [[15, 0], [16.5, 1.5]]], atol=1e-4
    )
    lower = opened(whole, ImageConfig(front_rows=(10, 32), divisor=8)).example(0).traffic_elements
    assert lower.valid.tolist() == [True, False, False]
    assert lower.attribute[0] == 2


@pytest.mark.parametrize(("flavour", "lanes", "segments"), [("centerline", 3, 0), ("lane_segment", 0, 3)])
def test_flavours_fill_their_own_part(whole, flavour, lanes, segments):
    example = opened(whole, None, flavour=flavour).example(0)
    example.validate()
    assert example.cameras is None
    assert (example.lanes.valid.sum(), example.segments.valid.sum()) == (lanes, segments)
    assert example.areas.valid.sum() == (flavour == "lane_segment")
    governs = example.traffic_elements.lane if flavour == "centerline" else example.traffic_elements.segment
    assert len(governs) == (5 if flavour == "centerline" else 4)
    assert governs[:3, :2].tolist() == [[True, False], [False, False], [False, True]]
    np.testing.assert_allclose(example.traffic_elements.box[0], [[10, 4], [14, 12.5]])


def test_crossings_may_be_two_sides(folder):
    outline = [[5.0, -3.0, 0.1], [5.0, 3.0, 0.1], [8.0, 3.0, 0.1], [8.0, -3.0, 0.1], [5.0, -3.0, 0.1]]
    crossing = {"id": 1, "category": 1, "points": outline}
    change(info(folder, 0, "-ls"), lambda record: record["annotation"]["area"].append(crossing))
    for form, corners in (("ring", [0, 0]), ("sides", [0, 1, 2, 3])):
        example = opened(folder, None, flavour="lane_segment", example=replace(SIZES, crossings=form)).example(0)
        assert example.areas.category.tolist() == [2, 1]
        ends = [0, -1] if form == "ring" else [0, 9, 10, 19]
        np.testing.assert_allclose(example.areas.points[1, ends], [outline[i] for i in corners], atol=1e-6)
        np.testing.assert_allclose(example.areas.points[0, [0, -1]], [[5, -3, 0], [5, 3, 0]], atol=1e-6)


@pytest.mark.parametrize("log", ["75e8adad-50a6-3245-8726-5e612db3d165", "20ec831deb0f44e397497198cbe5a97c"])
def test_logs_whose_map_has_changed_may_be_left_out(folder, log):
    """One of subset A, one of subset B."""
    data = OpenLaneV2Data(folder, val="train", subset="B")
    before = len(OpenLaneV2Dataset(data.source("train")))

    def frames(split):
        return len(OpenLaneV2Dataset(replace(data, map_changes="drop").source(split)))

    assert frames("train") == before
    for path in (folder / "train").rglob("info/*.json"):
        change(path, lambda record: record["meta_data"].update(source_id=log))
    assert (frames("train"), frames("val")) == (0, before)
    change(info(folder), lambda record: record.pop("meta_data"))
    with pytest.raises(UserError, match="meta_data"):
        frames("train")


def test_items_beyond_capacity_are_left_out_with_their_edges(whole):
    dataset = opened(whole, None, example=ExampleConfig(lanes=2, elements=1))
    with pytest.warns(TruncationWarning, match="more (lanes|elements)"):
        example = dataset.example(0)
    # Lane 1 is the farthest; element 0 has the larger box.
    np.testing.assert_allclose(example.lanes.points[:, 0, 1], [0, 3.5], atol=1e-4)
    assert not example.lanes.successor.any()
    assert example.traffic_elements.lane.tolist() == [[True], [False]]


def test_a_split_without_annotations(folder):
    (folder / "train").rename(folder / "test")
    content = json.loads((folder / "data_dict_subset_B.json").read_text())
    (folder / "data_dict_subset_B.json").write_text(json.dumps({"test": content["train"]}))
    for path in (folder / "test").glob("*/info/*.json"):
        change(path, lambda content: content.pop("annotation"))
    for path in (folder / "test").glob("*/image"):
        shutil.copytree(path, folder / "train" / path.parent.name / "image")
    example = opened(folder, split="test").example(1)
    assert example.cameras.valid.all()
    assert not example.lanes.valid.any()
    assert not example.traffic_elements.valid.any()
    assert example.has_previous


def test_a_camera_that_a_frame_lacks_is_not_valid(folder):
    change(info(folder), lambda content: content["sensor"].pop("CAM_BACK"))
    views = opened(folder).example(0).cameras
    assert views.valid.tolist() == [True, True, True, False, True, True]
    assert not views.image[3].any()


def test_folders_stand_in_for_a_split_file(folder):
    (folder / "data_dict_subset_B.json").unlink()
    assert len(opened(folder)) == FRAMES
    assert [key.timestamp for key in opened(folder).keys] == [path.stem for path in map(info, [folder] * 3, range(3))]


def copied_image(folder):
    small = folder / "train/01000/image/CAM_BACK_RIGHT"
    image = next((folder / "train/01000/image/CAM_FRONT").iterdir())
    image.write_bytes(next(small.iterdir()).read_bytes())


def calibrated(part, **values):
    return lambda folder: change(info(folder), lambda content: content["sensor"]["CAM_FRONT"][part].update(values))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda folder: next((folder / "train/01000/image/CAM_BACK").iterdir()).unlink(), "cannot read .*CAM_BACK"),
        (copied_image, "the first image of CAM_FRONT is 48 x 16: one of them is not the original"),
        (lambda folder: info(folder).write_text("{"), "is no JSON file"),
        (lambda folder: change(info(folder), lambda content: content.pop("sensor")), "lacks the entry 'sensor'"),
        (calibrated("intrinsic", K=[[1, 0, 0], [0, 0, 0], [0, 0, 1]]), "is no camera matrix"),
        (calibrated("intrinsic", K=[[1e39, 0, 0], [0, 1, 0], [0, 0, 1]]), r"CAM_FRONT\.intrinsic\.K holds 1e\+39"),
        (calibrated("extrinsic", translation=[0, 0, 1e39]), r"CAM_FRONT\.extrinsic\.translation holds 1e\+39"),
        (lambda folder: info(folder, 1).unlink(), r"1 of 3 frames are missing \(train/01000/"),
        (lambda folder: shutil.rmtree(folder / "train"), "3 of 3 frames are missing"),
        (lambda folder: (folder / "data_dict_subset_B.json").write_text("{}"), "lacks the entry 'train'"),
        (lambda folder: (folder / "data_dict_subset_B.json").write_text('{"train": {}}'), "names no frame of split"),
        (shutil.rmtree, "there is no folder"),
    ],
)
def test_faults_are_named(folder, damage, said):
    damage(folder)
    with pytest.raises(UserError, match=said):
        list(map(opened(folder).example, range(FRAMES)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"subset": "A", "data_dict": "folders"}, "camera 'CAM_FRONT' is none of subset A .*set `subset` to B"),
        ({"image": ImageConfig(front_rows=(356, 1906))}, "front images have 32 rows"),
        ({"image": ImageConfig(scale=0.01)}, "leaves nothing"),
        ({"split": "val", "data_dict": "folders"}, "holds no val/<segment>"),
    ],
)
def test_settings_that_do_not_fit_the_folder_are_named(whole, change, said):
    with pytest.raises(UserError, match=said):
        opened(whole, **change).example(0)


def test_streamed_frames_can_be_trained_on(whole):
    """Streamed and augmented by workers; shapes as announced."""
    data = OpenLaneV2Data(
        whole, val="train", subset="B", image=NATIVE, example=SIZES, loading=StreamingConfig(threads=2, ahead=2)
    )
    config = RunConfig(data=data)
    task = config.task
    loaded = task.load(data.source("train"))
    assert isinstance(loaded, Streamed)
    shapes = task.shapes(config.data)
    plain, coloured = (
        next(batches(loaded, (0,), range(1), 2, prepare))[0] for prepare in (None, task.prepare(config.data))
    )
    kept = task.load(replace(data, loading=StreamingConfig(where="memory", threads=2)).source("train"), progress=False)
    jax.tree.map(np.testing.assert_array_equal, plain, next(batches(kept, (0,), range(1), 2))[0])
    assert plain.cameras.image.shape == (2, *shapes.cameras.image.shape)
    assert plain.segments.valid.shape == (2, 0)  # not a training part
    assert (plain.cameras.image != coloured.cameras.image).any()
    np.testing.assert_array_equal(plain.lanes.points, coloured.lanes.points)
    nothing = RunConfig(data=OpenLaneV2Data(whole, augmentation=None))
    assert task.prepare(nothing.data) is None
    assert data.augmentation == PhotometricConfig()


def test_the_command_line_names_it(whole):
    def chosen(*arguments, config=None):
        options = build_parser().parse_args(["eval", "run", "--split", "val", *arguments])
        return chosen_source(config or RunConfig(), options)

    source = chosen("--data", "openlane-v2", "--root", str(whole))
    assert (source.root, source.split, source.subset, source.image) == (whole, "val", "B", TOPONET_SUBSET_B)
    own = RunConfig(data=OpenLaneV2Data(whole, val="train", image=NATIVE))
    assert chosen(config=own) == own.data.source("val")
    assert chosen("--root", "elsewhere", config=own) == replace(own.data.source("val"), root=Path("elsewhere"))
    with pytest.raises(UserError, match="needs --root"):
        chosen("--data", "openlane-v2")


def test_a_world_too_large_for_memory_is_streamed(tmp_path, monkeypatch):
    kept = cached(FakeDataset(FakeConfig(5)), root=tmp_path, workers=1, progress=False)
    monkeypatch.setattr("tflane_jax.datasets.sources.open_dataset", lambda source, progress: kept)
    task, source = RunConfig().task, RunConfig().data.source("train")
    whole = task.load(source)
    monkeypatch.setattr("tflane_jax.datasets.loading.IN_MEMORY", 1000)
    large = task.load(source)
    assert isinstance(large, Streamed)
    for one, other in zip(*(batches(data, (3,), range(4), 2) for data in (whole, large)), strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)


def test_shapes_need_no_data():
    shapes = RunConfig().task.shapes(RunConfig(data=OpenLaneV2Data(Path("nowhere"))).data)
    assert shapes.cameras.image.shape == (7, 800, 1024, 3)
    assert shapes.traffic_elements.lane.shape == (128, 48)
    assert shapes.cameras.vehicle is None
    assert nominal_example(OpenLaneV2Config(Path("nowhere"), can_bus="reference")).cameras.vehicle.can_bus.shape == (
        18,
    )


def test_published_weights_read_the_pose(whole):
    """Of the third frame: 5 m farther, turned by 0.04."""
    assert opened(whole).example(2).cameras.vehicle is None
    found = opened(whole, can_bus="reference").example(2).cameras.vehicle.can_bus
    np.testing.assert_allclose(found[:7], [5.0, 0.0, 0.0, *[np.cos(0.02)] * 4], atol=1e-5)
    np.testing.assert_allclose(found[7:], [*[0.0] * 9, 0.04, 2.2918312], atol=1e-4)


@pytest.mark.parametrize(("subset", "frames"), [("A", (22_477, 4_806, 4_816)), ("B", (27_968, 6_019, 6_008))])
def test_the_official_split_files(subset, frames):
    root = shared_path("data/openlanev2/OpenLane-V2")
    keys = [list_frames(root, split, subset) for split in ("train", "val", "test")]
    assert tuple(map(len, keys)) == frames
    times = [int(key.timestamp) for key in keys[0] if key.segment == keys[0][0].segment]
    assert times == sorted(times)


def test_the_tutorial_frame_looks_ahead_over_the_road():
    """The real front camera: a point on the road ahead lies low in the middle, in the scaled picture too."""
    folder = shared_path("data/openlanev2/tutorial_frame")
    frame = json.loads((folder / "frame.json").read_text())
    intrinsics = np.array(frame["intrinsic"]["K"])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame["extrinsic"]["rotation"], frame["extrinsic"]["translation"]
    camera_from_ego = np.linalg.inv(pose)
    points = np.array([[20.0, 0.0, -0.33], [20.0, 3.0, -0.33], [1e6, 0.0, 0.0]])
    pixels, depth, valid = project(points, intrinsics, camera_from_ego)
    assert valid.all()
    np.testing.assert_allclose(depth[:2], 18.4, atol=0.3)
    assert abs(pixels[0, 0] - 775) < 60
    assert pixels[0, 1] > pixels[2, 1] + 100  # the road is below the horizon
    assert pixels[1, 0] < pixels[0, 0] - 200  # left is left
    assert abs(pixels[2, 1] - 1024) < 60
    width, height = frame["original_image_size_wh"]
    fit = fit_image(width, height, ImageConfig(front_size=tuple(frame["png_size_wh"])), front=True)
    np.testing.assert_allclose(fit.scale, (0.33742, 0.33789), atol=1e-5)
    small, _, _ = project(points, fit.intrinsics(intrinsics), camera_from_ego)
    np.testing.assert_allclose(small, pixels * fit.scale, rtol=1e-6)
