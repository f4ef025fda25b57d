"""The SD-map prior: coordinates, labels, padding, numpy against jit, the reference's numbers."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import case_id, golden_modules, load_module_case
from tflane_jax.datasets.geojson import CATEGORIES
from tflane_jax.geometry import PerceptionRange
from tflane_jax.priors.sd_map import SdMapPriorConfig
from tflane_jax.priors.sd_map import sd_map_lines as lines_within
from tflane_jax.scene import SdCategory, SdMap
from tflane_jax.world.roads.sd_map import pack_lines

CONFIG = SdMapPriorConfig(categories=8)
sd_map_lines = functools.partial(lines_within, bev_range=PerceptionRange((-40.0, 40.0), (-20.0, 20.0)))
EVERYWHERE = PerceptionRange((-1e4, 1e4), (-1e4, 1e4))


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("smerf_sdmap_parametrize*"), ids=case_id)
def test_lines_become_the_reference_s_points_and_labels(path):
    case = load_module_case(path)
    count = len(case.outputs["map_graph"])
    lines = [case.inputs[f"{i}.polyline"] for i in range(count)]
    names = [str(case.inputs[f"{i}.category"]) for i in range(count)]
    assert {name: int(category) for name, category in CATEGORIES.items()} == case.meta["category2id"]
    points = case.meta["n_points"]
    sd_map, dropped = pack_lines(
        lines, [CATEGORIES[name] for name in names], capacity=count + 2, points=points, range_=EVERYWHERE
    )
    assert dropped == 0
    np.testing.assert_allclose(sd_map.points[:count], case.outputs["map_graph"], atol=1e-5)
    found = sd_map_lines(sd_map, CONFIG)
    np.testing.assert_array_equal(found.labels[:count], case.outputs["onehot"])
    assert found.valid.tolist() == [True] * count + [False] * 2


def small_map(filler=0.0):
    sd_map = SdMap.empty(4, 3)
    sd_map.points[:] = filler
    sd_map.points[0] = [[-40, -20], [0, 0], [40, 20]]
    sd_map.points[2] = [[80, 0], [0, 10], [20, -40]]
    sd_map.category[:] = [SdCategory.CROSSWALK, -3, SdCategory.OTHER, 99]
    sd_map.valid[[0, 2]] = True
    return sd_map


def test_coordinates_span_the_range_and_labels_are_one_hot():
    found = sd_map_lines(small_map(), CONFIG)
    np.testing.assert_allclose(found.points[0], [[0, 0], [0.5, 0.5], [1, 1]])
    np.testing.assert_allclose(found.points[2], [[1.5, 0.5], [0.5, 0.75], [0.75, -0.5]])
    assert np.argwhere(found.labels).tolist() == [[0, 1], [2, 7]]
    assert not found.points[[1, 3]].any()


@pytest.mark.parametrize("categories", [3, int(SdCategory.OTHER)])
def test_a_category_beyond_the_labels_counts_as_the_last(categories):
    found = sd_map_lines(small_map(), dataclasses.replace(CONFIG, categories=categories))
    assert np.argwhere(found.labels).tolist() == [[0, 1], [2, categories - 1]]


@pytest.mark.parametrize("filler", [0.0, np.nan])
def test_jit_gives_the_same_whatever_padding_holds(filler):
    host = sd_map_lines(small_map(), CONFIG)
    device = jax.jit(lambda m: sd_map_lines(m, CONFIG))(jax.tree.map(jnp.asarray, small_map(filler)))
    for field in dataclasses.fields(host):
        a, b = getattr(host, field.name), np.asarray(getattr(device, field.name))
        assert a.dtype == b.dtype, field.name
        np.testing.assert_allclose(a, b, rtol=1e-6, err_msg=field.name)


@pytest.mark.parametrize("lines", [0, 1])
def test_sizes(lines):
    found = sd_map_lines(SdMap.empty(lines, 1), CONFIG)
    assert found.points.shape == (lines, 1, 2)
    assert found.labels.shape == (lines, 8)
    assert not found.valid.any()
