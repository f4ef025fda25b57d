"""TuSimple's label files and images as a dataset."""

import json
from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.datasets.small_tusimple import ROWS_48, dataset_of, write_tusimple
from tests.shared import shared_path
from tflane_jax.datasets import sources
from tflane_jax.datasets.augmentation import AugmentationConfig
from tflane_jax.datasets.base import TruncationWarning
from tflane_jax.datasets.batches import batches
from tflane_jax.datasets.lane_rows import lane_lines, row_lanes
from tflane_jax.datasets.streaming import Streamed, StreamingConfig
from tflane_jax.datasets.tusimple import TuSimpleConfig, TuSimpleData, load_road_images
from tflane_jax.errors import UserError
from tflane_jax.evaluation.results import EvaluationConfig
from tflane_jax.files.tusimple import ROWS, RowLanes
from tflane_jax.metrics.tusimple import TuSimpleMetrics, score_image
from tflane_jax.scene import CurvePrediction, Prediction
from tflane_jax.tasks.lane_shape import LaneShapeTask, found_lanes


@pytest.fixture
def root(tmp_path):
    return write_tusimple(tmp_path)


def test_labels_of_48_heights_stand_in_the_56_rows(root):
    dataset = dataset_of(root)
    assert [dataset.raw_file(i) for i in (0, 3)] == ["clips/0/0/20.jpg", "clips/1/1/20.jpg"]
    for index, first in ((0, 13), (2, 5)):
        example = dataset.example(index)
        example.validate()
        assert dataset.info(index).scene == dataset.raw_file(index)
        assert example.image.shape == (360, 640, 3)
        assert np.abs(example.image.astype(int) - 40 * index).max() <= 1
        assert example.image_valid.all()
        lines = example.lines
        np.testing.assert_array_equal(lines.valid, [True, True] + [False] * 6)  # the all -2 lane is no line
        np.testing.assert_array_equal(lines.point_valid[:2], np.broadcast_to(np.arange(56) >= first, (2, 56)))
        assert not lines.point_valid[2:].any()
        np.testing.assert_allclose(lines.points[..., 1] * 720, np.broadcast_to(ROWS, (8, 56)), rtol=1e-6)
        left = 100 + np.arange(56 - first)
        np.testing.assert_allclose(lines.points[0, first:, 0] * 1280, left, rtol=1e-6)  # sorted from left to right
        np.testing.assert_allclose(lines.points[1, first:, 0] * 1280, left + 500, rtol=1e-6)


def loaded(root, where, **workers):
    config = TuSimpleConfig(str(root), loading=StreamingConfig(where=where, **workers))
    return sources.load(config, progress=False)


def test_streamed_images_are_those_in_memory(root, monkeypatch):
    """Batches, augmentation in workers, labels; "auto" goes by size."""
    task = LaneShapeTask()
    prepare = task.prepare(TuSimpleData(root))
    kept = loaded(root, "memory")
    expected = list(batches(task.examples(kept), (2,), range(3), 3, prepare))
    for threads in (0, 2):
        read = loaded(root, "disk", threads=threads)
        assert isinstance(task.examples(read), Streamed)
        assert [truth.x.tolist() for truth in read.truth] == [truth.x.tolist() for truth in kept.truth]
        for one, other in zip(batches(task.examples(read), (2,), range(3), 3, prepare), expected, strict=True):
            jax.tree.map(np.testing.assert_array_equal, one, other)
    assert not isinstance(loaded(root, "auto").images, Streamed)
    monkeypatch.setattr("tflane_jax.datasets.tusimple.IN_MEMORY", 1000)
    assert isinstance(loaded(root, "auto").images, Streamed)


@pytest.mark.parametrize("where", ["memory", "disk"])
def test_training_images_are_cut_from_full_frames(root, where):
    """As LSTR crops, so that fine detail stays sharp; without augmentation, no full frame is read."""
    rng = np.random.default_rng(0)
    for path in root.rglob("*.jpg"):
        assert cv2.imwrite(str(path), np.repeat(rng.integers(0, 256, (720, 1280, 1), np.uint8), 3, 2))
    task, data = LaneShapeTask(), TuSimpleData(root, train="all", loading=StreamingConfig(where=where, threads=0))
    still = AugmentationConfig(1.0, rotation=0.0, brightness=0.0, contrast=0.0, saturation=0.0, lighting=0.0)
    data = replace(data, augmentation=still)
    source = data.source("train")
    small, full = (task.load(one, progress=False) for one in (source, task.training_form(source, data)))
    ((plain,),) = batches(task.examples(small), (2,), range(1), 3)
    ((sharp,),) = batches(task.examples(full), (2,), range(1), 3, task.prepare(data))
    ((blurred,),) = batches(task.examples(small), (2,), range(1), 3, task.prepare(data))
    assert sharp.image.shape == blurred.image.shape == plain.image.shape == (3, 360, 640, 3)
    detail = lambda batch: float(np.var(np.diff(np.asarray(batch.image, float), axis=2)))  # noqa: E731
    assert task.training_form(source, replace(data, augmentation=None)) == source
    assert detail(sharp) > 1.3 * detail(blurred)
    assert task.shapes(data).image.shape == sharp.image.shape[1:]


@pytest.mark.parametrize(("damage", "said"), [("cut", "is empty: copy"), ("lost", "No such file")])
@pytest.mark.parametrize("where", ["memory", "disk"])
def test_an_image_that_a_worker_cannot_read_is_named(root, where, damage, said):
    dataset = sources.open_dataset(TuSimpleConfig(str(root), loading=StreamingConfig(where=where, threads=1)))
    image = root / "clips/1/0/20.jpg"
    image.write_bytes(b"") if damage == "cut" else image.unlink()

    def read():
        data = sources.source_of(dataset.config).load(dataset, False, (), dataset.config.loading)
        list(batches(data.images, (2,), range(4), 2))

    with pytest.raises(UserError, match=f"{image}.*{said}"):
        read()


class Straight(LaneShapeTask):
    """Sees one lane in every image."""

    def predict(self, params, example):
        logits, curves = (
            jnp.array([[0.0, 3.0], [3.0, 0.0]]),
            jnp.tile(jnp.array([0.4, 0.9, 0, 0, 0, 0.5, 0, 0.1]), (2, 1)),
        )
        return Prediction(curves=CurvePrediction(logits, curves + 0 * jnp.mean(example.image)))


def test_streamed_images_are_evaluated_as_those_in_memory(root, monkeypatch):
    monkeypatch.setattr("tflane_jax.tasks.lane_shape._losses", lambda task, curves, lines: lines.points.sum((1, 2, 3)))
    kept, read = (
        Straight().evaluate({}, loaded(root, where), EvaluationConfig(batch_size=3)) for where in ("memory", "disk")
    )
    assert kept == read
    assert kept.scores()["all/loss"] > 0


def test_truth_is_what_the_file_says(root):
    truth = dataset_of(root).truth(0)
    assert truth.rows is not None
    np.testing.assert_array_equal(truth.rows, ROWS_48)
    assert truth.x.shape == (3, 48)
    assert (truth.x[2] == -2).all()


@pytest.mark.parametrize("read_first", [False, True])
def test_images_of_another_size_are_measured_in_their_own_pixels(tmp_path, read_first):
    """A lane u = 0.2 + v / 2, predicted as labelled, in an image of 1640 x 590; the other one is TuSimple's."""
    records, sizes = [], {"wide.png": (590, 1640), "own.png": (720, 1280)}
    for name, (height, width) in sizes.items():
        assert cv2.imwrite(str(tmp_path / name), np.zeros((height, width, 3), np.uint8))
        rows = np.arange(240, height, 10)
        lane = width * (0.2 + 0.5 * rows / height)
        records.append({"raw_file": name, "lanes": [lane.tolist()], "h_samples": rows.tolist()})
    (tmp_path / "label_data_mine.json").write_text("".join(json.dumps(record) + "\n" for record in records))
    dataset = dataset_of(tmp_path)
    logits, curves = np.array([[0.0, 1.0]]), np.array([[0.0, 1.0, 0, -1, 0, 0.2, 0.5, 0]])
    for index, size in enumerate(sizes.values()):
        if read_first:
            dataset.example(index)
        truth = dataset.truth(index)
        assert truth.size == size
        found = found_lanes(CurvePrediction(logits, curves), truth)
        np.testing.assert_allclose(found.x, truth.x, rtol=1e-5)
        assert score_image(found, truth) == (1.0, 0.0, 0.0)
    labels = loaded(tmp_path, "disk").truth
    assert [truth.size for truth in labels] == list(sizes.values())


def test_missing_images_are_one_error(root):
    for name in ("0/0", "0/1", "1/0", "1/1"):
        (root / "clips" / name / "20.jpg").unlink()
    names = r"\(clips/0/0/20.jpg, clips/0/1/20.jpg, clips/1/0/20.jpg, \.\.\.\)"
    with pytest.raises(UserError, match=rf"4 of 4 labelled images are missing {names}: unpack"):
        dataset_of(root)


def test_labels_without_their_images_are_refused():
    root = shared_path("data/tusimple/labels_only")
    with pytest.raises(UserError, match="2858 of 2858 labelled images are missing"):
        dataset_of(root)


@pytest.mark.parametrize("index", [-1, 4])
def test_indices_outside_the_dataset_are_errors(root, index):
    dataset = dataset_of(root)
    for read in (dataset.example, dataset.truth, dataset.raw_file, dataset.info):
        with pytest.raises(IndexError, match="tusimple-all has 4 examples"):
            read(index)


@pytest.mark.parametrize("workers", [1, 3])
def test_loading_stacks_the_examples_in_order(root, workers):
    dataset = dataset_of(root, height=36, width=64)
    arrays = load_road_images(dataset, progress=False, workers=workers)
    assert arrays.image.shape == (4, 36, 64, 3)
    for index in range(4):
        jax.tree.map(lambda a, b, i=index: np.testing.assert_array_equal(a[i], b), arrays, dataset.example(index))


def test_a_damaged_image_ends_loading_with_its_name(root):
    (root / "clips/1/0/20.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(UserError, match=r"clips/1/0/20.jpg is damaged"):
        load_road_images(dataset_of(root), progress=False)


@pytest.mark.parametrize("lanes", [np.zeros((0, 56)), np.full((2, 56), -2.0), np.zeros((0, 0))])
def test_images_without_lanes(lanes):
    rows = ROWS[: lanes.shape[1]]
    lines = lane_lines(RowLanes(lanes, rows), height=720, width=1280)
    assert not lines.valid.any()
    assert not lines.point_valid.any()
    assert row_lanes(lines).x.shape == (0, 56)


def test_too_many_lines_leave_out_the_shortest():
    x = np.where(np.arange(56) < np.array([[30], [10], [50]]), [[300.0], [200.0], [100.0]], -2.0)
    with pytest.warns(TruncationWarning, match="an image has 3 lines and room for 2: raise `capacity`"):
        lines = lane_lines(RowLanes(x, ROWS), height=720, width=1280, capacity=2)
    np.testing.assert_array_equal(lines.point_valid.sum(1), [50, 30])
    assert lane_lines(RowLanes(x, ROWS), height=720, width=1280, capacity=3).valid.all()


def test_other_rows_are_interpolated_where_labelled_on_both_sides():
    """A 1080-row camera: TuSimple's row r is row 1.5 r of its image, between labels of every 20 rows."""
    rows = np.arange(300.0, 1080.0, 20.0)
    x = (rows * 2.0)[None].copy()
    x[0, 10] = -2  # a gap at row 500
    lines = lane_lines(RowLanes(x[:, ::-1], rows[::-1]), height=1080, width=4000, capacity=1)
    own = ROWS * 1.5
    inside = (own >= 300.0) & (own <= 1060.0) & ~((own > 480.0) & (own < 520.0))
    np.testing.assert_array_equal(lines.point_valid[0], inside)
    np.testing.assert_allclose(lines.points[0, inside, 0], own[inside] * 2.0 / 4000, rtol=1e-6)


def test_rows_return_from_lines(root):
    dataset = dataset_of(root)
    truth, lines = dataset.truth(2), dataset.example(2).lines
    back = row_lanes(lines)
    assert back.rows is not None
    np.testing.assert_array_equal(back.rows, ROWS)
    np.testing.assert_allclose(back.x, truth.x[[1, 0]], rtol=1e-6)  # left to right
    points = np.where(lines.point_valid[..., None], lines.points, np.nan)
    np.testing.assert_array_equal(row_lanes(replace(lines, points=points)).x, back.x)
    with pytest.raises(ValueError, match="do not stand at TuSimple's rows"):
        row_lanes(replace(lines, points=lines.points + np.float32(0.01)))
    left = replace(lines, points=lines.points - np.float32([0.1, 0.0]))  # 128 pixels
    assert ((row_lanes(left).x == -2) | (row_lanes(left).x >= 0)).all()


@pytest.mark.golden
def test_real_frames_agree_with_their_labels():
    dataset = dataset_of(shared_path("data/tusimple/LaneDetection"))
    arrays = load_road_images(dataset, progress=False)
    assert len(dataset) == len(arrays.image) == 10
    metrics = TuSimpleMetrics()
    for index in range(10):
        truth, lines = dataset.truth(index), dataset.example(index).lines
        assert truth.rows is not None
        assert lines.valid.sum() == (truth.x >= 0).any(1).sum()
        found = row_lanes(lines)
        metrics.update(RowLanes(found.x[:, np.searchsorted(ROWS, truth.rows)]), truth)
    # One frame labels a lane without points, which no prediction can find.
    scores = metrics.compute()
    assert scores["FP"] == 0.0
    assert scores["FN"] == pytest.approx(0.025)
    assert scores["Accuracy"] > 0.97
