"""Shapes of nuScenes' examples without its files: a model is counted, planned and built before the data are there."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.datasets.nuscenes_small import START, tables, write_nuscenes
from tests.datasets.test_nuscenes import SIZES, write_images
from tflane_jax.config import load_config
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.datasets.nuscenes import NuScenesConfig, NuScenesDataset, nominal_example
from tflane_jax.datasets.view_images import TOPONET_SUBSET_B
from tflane_jax.markers.simulation import MarkerConfig
from tflane_jax.scene import shapes_of

pytest.importorskip("shapely")
SETTINGS = {
    "evidence": {"example": SIZES},
    "lines": {"example": replace(SIZES, sensor=None, map_lines=MapLinesConfig(lines=9), history=7)},
    "markers": {"example": replace(SIZES, markers=MarkerConfig())},
    "images": {"image": TOPONET_SUBSET_B, "example": SIZES},
    "depth": {"image": TOPONET_SUBSET_B, "example": SIZES, "depth_cell": 32, "frame": "lidar"},
    "messages": {"image": TOPONET_SUBSET_B, "example": SIZES, "can_bus": "reference"},
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """The small data set, with front images of the official size, a sweep and messages of the vehicle."""
    root = tmp_path_factory.mktemp("nuscenes")
    write_images(root, (1600, 900))
    content = tables()
    for row in content["sample_data"]:
        row |= {"width": 1600, "height": 900} if row["width"] else {}
    write_nuscenes(root, content)
    (root / "samples" / "LIDAR_TOP").mkdir()
    np.zeros((1, 5), "<f4").tofile(root / "samples" / "LIDAR_TOP" / "a0.jpg")
    (root / "can_bus").mkdir()
    message = {"utime": START, "accel": [0, 0, 9], "rotation_rate": [0, 0, 0], "vel": [5, 0, 0]}
    (root / "can_bus" / "scene-0061_pose.json").write_text(json.dumps([message]))
    return root


@pytest.mark.parametrize("name", SETTINGS)
def test_shapes_are_those_of_real_examples(root, tmp_path, name):
    config = NuScenesConfig(root, **SETTINGS[name])
    made = nominal_example(replace(config, root=tmp_path / "none"))
    made.validate()
    assert shapes_of(made) == shapes_of(NuScenesDataset(config).example(0))
    assert not made.traffic_flow.valid.any()


@pytest.mark.parametrize("name", ["maptr_tfm_r50", "maptrv2_tfm_r50"])
def test_the_papers_sizes_need_no_data(name):
    """Regression: `tflane summary --config tf_lane/maptr_tfm_r50` asked for nuScenes."""
    config = load_config(f"tf_lane/{name}")
    assert not config.data.root.exists()
    example = config.task.shapes(config.data)
    assert example.cameras.image.shape == (6, 480, 800, 3)
    assert example.traffic_flow.valid.shape == (160, ExampleConfig().history)
