"""Front views of the built-in world as a dataset."""

import pickle
from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.shared import assert_same
from tflane_jax.datasets import cache, sources
from tflane_jax.datasets.front_views import FrontViewConfig, FrontViewData, FrontViewDataset, load_road_images
from tflane_jax.datasets.leaves import IMAGE_PARTS, example_leaves, image_from_leaves
from tflane_jax.datasets.streaming import StreamingConfig
from tflane_jax.errors import UserError
from tflane_jax.world.front_view.views import FrontWorldConfig, draw_front_scene

SMALL = FrontViewConfig(split="val", images=3, first=5)


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TFLANE_CACHE", str(tmp_path))


def test_settings_of_the_world_reach_every_split():
    data = FrontViewData(world=FrontWorldConfig(severity=1.0))
    assert {data.source(split).world for split in ("train", "val", "test")} == {FrontWorldConfig(severity=1.0)}


def test_splits_own_disjoint_ranges_of_ids():
    ends = []
    for split in ("train", "val", "test"):
        dataset = FrontViewDataset(FrontViewConfig(split, 10**8))
        ends.append((dataset.scene_id(0), dataset.scene_id(len(dataset) - 1)))
    assert ends == [(0, 10**8 - 1), (10**8, 2 * 10**8 - 1), (2 * 10**8, 3 * 10**8 - 1)]


@pytest.mark.parametrize(("images", "first"), [(-1, 0), (1, -1), (1, 10**8), (10**8 + 1, 0)])
def test_images_outside_the_split_are_refused(images, first):
    with pytest.raises(UserError, match="train has images 0 to 99999999"):
        FrontViewDataset(FrontViewConfig(images=images, first=first))


@pytest.mark.parametrize("index", [-1, 3])
def test_indices_outside_the_dataset_are_errors(index):
    with pytest.raises(IndexError, match="front-views-val"):
        FrontViewDataset(SMALL).example(index)


def test_an_image_depends_on_its_number_alone():
    dataset = FrontViewDataset(SMALL)
    other = pickle.loads(pickle.dumps(FrontViewDataset(replace(SMALL, images=1, first=6))))
    assert_same(other.example(0), dataset.example(1))
    assert (len(dataset), dataset.name, dataset.config) == (3, "front-views-val", SMALL)
    assert dataset.info(1).scene == other.info(0).scene == "front-100000006"


def test_the_weather_of_an_image_is_that_of_its_scene():
    dataset = FrontViewDataset(FrontViewConfig("test", 30, world=FrontWorldConfig(severity=1.0)))
    drawn = [draw_front_scene(dataset.scene_id(index), dataset.config.world).weather.kind for index in range(30)]
    assert [dataset.weather(index) for index in range(30)] == [kind.value for kind in drawn]
    assert len(set(drawn)) > 3
    clear = FrontViewDataset(FrontViewConfig("test", 9, world=FrontWorldConfig(severity=0.0)))
    assert {clear.weather(index) for index in range(9)} == {"clear"}


def test_an_example_is_a_whole_road_image():
    example = FrontViewDataset(SMALL).example(0)
    example.validate()
    assert example.image.shape == (360, 640, 3)
    assert example.lines.points.shape == (8, 56, 2)
    assert example.image_valid.all()
    assert 2 <= example.lines.valid.sum() <= 5


def test_a_loaded_split_holds_the_examples(monkeypatch):
    loaded, dataset = load_road_images(SMALL, progress=False, workers=1), FrontViewDataset(SMALL)
    assert loaded.image.shape == (3, 360, 640, 3)
    assert loaded.image_valid.shape == (3, 360, 640)
    for index in range(3):
        assert_same(jax.tree.map(lambda leaf: leaf[index], loaded), dataset.example(index))  # noqa: B023
    monkeypatch.setattr(cache, "_build", lambda *_: pytest.fail("built twice"))
    assert_same(load_road_images(SMALL, progress=False), loaded)


@pytest.mark.slow
def test_other_processes_make_the_same_bits():
    config = FrontViewConfig(split="test", images=26, world=_tiny())
    loaded, dataset = load_road_images(config, progress=False, workers=2), FrontViewDataset(config)
    for index in (0, 11, 25):
        assert_same(jax.tree.map(lambda leaf: leaf[index], loaded), dataset.example(index))  # noqa: B023


def test_images_are_mapped_or_kept_in_memory():
    config = FrontViewConfig(split="test", images=2, world=_tiny())
    mapped, kept = (
        sources.load(replace(config, loading=StreamingConfig(where=where)), progress=False)
        for where in ("auto", "memory")
    )
    assert isinstance(mapped.images.image.base, np.memmap)
    assert kept.images.image.flags.owndata
    assert_same(mapped.images, kept.images)


def _tiny() -> FrontWorldConfig:
    world = FrontWorldConfig()
    return replace(world, camera=replace(world.camera, width=128, height=72))


@pytest.mark.parametrize("images", [0, 1])
def test_the_smallest_splits(images):
    loaded = load_road_images(FrontViewConfig(images=images, world=_tiny()), progress=False, workers=1)
    assert loaded.image.shape == (images, 72, 128, 3)
    assert loaded.image_valid.shape == (images, 72, 128)
    assert loaded.lines.points.shape == (images, 8, 56, 2)
    assert loaded.lines.valid.dtype == loaded.lines.point_valid.dtype == bool


def test_road_images_survive_as_leaves():
    example = FrontViewDataset(SMALL).example(0)
    assert_same(image_from_leaves(example_leaves(example)), example)
    assert set(IMAGE_PARTS) == {"lines"}
    assert image_from_leaves(example_leaves(replace(example, image_valid=None))).image_valid is None
