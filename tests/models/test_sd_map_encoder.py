"""SMERF's map encoder and fusion: absent maps, padding, both BEV encoders."""

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.models.cases import BASELINE, make_example
from tests.models.test_bevformer import CONFIG, levels, ring
from tests.parameters import random_params
from tests.slow import with_slow
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.layers.polyline_encoder import (
    MARKER_POLYLINES,
    PolylineEncoder,
    PolylineEncoderConfig,
    temperature_encoding,
)
from tflane_jax.models.bevformer import BevFormer, BevFormerConfig
from tflane_jax.models.evidence_encoder import EvidenceEncoder, EvidenceEncoderConfig
from tflane_jax.models.priors import PriorsConfig
from tflane_jax.models.sd_map_encoder import SdMapEncoder, SdMapFusion, SdMapModuleConfig, sd_map_mask
from tflane_jax.scene import SdMap
from tflane_jax.tasks.lane_graph import LaneGraphTask


@pytest.mark.parametrize("layout", ["blocks", "interleaved"])
def test_encoding_of_points_is_equation_one(layout):
    points = np.random.default_rng(0).uniform(-0.1, 1.1, (3, 2)).astype(np.float32)
    out = jax.jit(lambda x: temperature_encoding(x, 6, layout=layout))(points)
    assert out.shape == (3, 12)
    for n in range(3):
        for axis in range(2):
            angles = [2 * np.pi * points[n, axis] / 1000 ** (2 * j / 6) for j in range(3)]
            waves = [(np.sin(a), np.cos(a)) for a in angles]
            expected = np.ravel(waves) if layout == "interleaved" else np.ravel(waves, "F")
            np.testing.assert_allclose(out[n, 6 * axis : 6 * axis + 6], expected, atol=2e-6)
    with pytest.raises(ValueError, match="must be even, not 5"):
        temperature_encoding(jnp.asarray(points), 5)


def fused_with(config, tokens, valid):
    """Return the callback of a BEV encoder that fuses these tokens."""

    def fuse(layer, shape, bev, position):
        return SdMapFusion(config, name=f"sd_map_{layer}")(bev, position, tokens, valid)

    return fuse


RANGE = BevGrid().range
NO_MAP = SdMap.empty(1, 11)
MODULE = SdMapModuleConfig(lines=PolylineEncoderConfig(8, 1, 2, 8, 0.0, 4), heads=2)
VALID = np.array([True, False, True])


def small_map(valid=VALID, filler=0.0):
    points = np.random.default_rng(0).uniform(-20, 20, (3, 11, 2)).astype(np.float32)
    return SdMap(
        np.where(valid[:, None, None], points, filler).astype(np.float32),
        np.where(valid, [0, 7, 1], -5 if np.isnan(filler) else 0).astype(np.int32),
        valid,
    )


@pytest.mark.parametrize("attend", ["lines", "points"])
def test_padding_changes_nothing_and_lines_have_no_order(attend):
    config = replace(MODULE, lines=replace(MODULE.lines, attend=attend, layout="interleaved"))
    encoder = SdMapEncoder(config, RANGE)
    params = random_params(encoder.init, NO_MAP)

    @jax.jit
    def run(sd_map):
        def scalar(params, points):
            tokens, valid = encoder.apply(params, sd_map.replace(points=points))
            return jnp.square(tokens).sum(), (tokens, valid)

        return jax.value_and_grad(scalar, (0, 1), has_aux=True)(params, sd_map.points)

    (total, (tokens, valid)), gradients = run(small_map())
    (_, (same, _)), also = run(small_map(filler=np.nan))
    np.testing.assert_array_equal(tokens, same)
    jax.tree.map(np.testing.assert_array_equal, also, gradients)
    assert total > 0
    assert valid.tolist() == VALID.tolist()
    assert not tokens[1].any()
    assert tokens[np.flatnonzero(VALID)].any(-1).all()
    order = np.array([2, 0, 1])
    (_, (turned, _)), _ = run(jax.tree.map(lambda leaf: leaf[order], small_map()))
    np.testing.assert_allclose(turned, tokens[order], atol=1e-5)
    alone = small_map(np.array([True, False, False]))
    (_, (by_itself, _)), _ = run(alone)
    # Lines attend to each other only if configured.
    assert (np.abs(by_itself[0] - tokens[0]).max() > 1e-3) == (attend == "lines")


@pytest.mark.parametrize("attend", ["lines", "points"])
@pytest.mark.parametrize("lines", [0, 1])
def test_sizes_of_a_map(attend, lines):
    encoder = PolylineEncoder(replace(MARKER_POLYLINES, dim=8, layers=1, heads=2, hidden=8, attend=attend))
    points, labels, valid = jnp.ones((lines, 3, 2)), jnp.zeros((lines, 0)), jnp.ones(lines, bool)
    params = random_params(encoder.init, jnp.ones((1, 3, 2)), jnp.zeros((1, 0)), jnp.ones(1, bool))
    out = jax.jit(encoder.apply)(params, points, labels, valid)
    assert out.shape == (lines, 8)
    assert np.isfinite(out).all()


@pytest.mark.parametrize("absent", with_slow(["nothing", "reference"], quick=["reference"]))
@pytest.mark.parametrize("lines", [0, 3])
def test_a_map_without_lines_changes_no_feature(absent, lines):
    rng = np.random.default_rng(1)
    bev, position = (jnp.asarray(rng.normal(size=(5, 8)), jnp.float32) for _ in range(2))
    fusion = SdMapFusion(replace(MODULE, absent=absent))
    params = random_params(fusion.init, bev, position, jnp.ones((1, 6)), jnp.ones(1, bool))

    @jax.jit
    def run(bev, tokens, valid):
        out, pull = jax.vjp(lambda p, b, t: fusion.apply(p, b, position, t, valid), params, bev, tokens)
        return out, pull(jnp.ones_like(out))

    out, (by_params, by_bev, by_tokens) = run(bev, jnp.full((lines, 6), jnp.nan), jnp.zeros(lines, bool))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_params))
    assert not by_tokens.any()
    if absent == "nothing":
        np.testing.assert_array_equal(out, bev)
        np.testing.assert_array_equal(by_bev, np.ones((5, 8)))
        assert not any(leaf.any() for leaf in jax.tree.leaves(by_params))
    else:
        inner = jax.tree.map(np.asarray, params["params"])
        total = np.asarray(bev) + inner["attention"]["output"]["bias"]
        unit = (total - total.mean(-1, keepdims=True)) / np.sqrt(total.var(-1, keepdims=True) + 1e-5)
        np.testing.assert_allclose(out, unit * inner["norm"]["scale"] + inner["norm"]["bias"], atol=1e-5)


@pytest.mark.parametrize("absent", ["nothing", "reference"])
@pytest.mark.parametrize("norm", ["sum", "query"])
def test_a_map_out_of_sight_of_all_cells_is_no_map(norm, absent):
    """Regression: with a radius and the norm around the sum, a map far from all cells normalised all features."""
    rng, config = np.random.default_rng(1), replace(MODULE, norm=norm, radius=5.0, absent=absent)
    bev, position, tokens = (jnp.asarray(rng.normal(size=(n, 8)), jnp.float32) for n in (5, 5, 3))
    cells, fusion = jnp.asarray(rng.uniform(-20, 20, (5, 2)), jnp.float32), SdMapFusion(config)
    near, far = small_map(np.ones(3, bool)), small_map(np.ones(3, bool))
    far.points[:] += 500.0
    params = random_params(fusion.init, bev, position, tokens, jnp.ones(3, bool))

    @jax.jit
    def run(sd_map):
        return fusion.apply(params, bev, position, tokens, sd_map.valid, sd_map_mask(sd_map, cells, config))

    gone = run(small_map(np.zeros(3, bool)))
    np.testing.assert_array_equal(run(far), gone)
    assert np.abs(run(near) - gone).max() > 1e-3
    assert np.array_equal(gone, bev) == (absent == "nothing")


class Fused(nn.Module):
    """A host's encoder with a map."""

    encoder: nn.Module
    fuses: bool = True

    @nn.compact
    def __call__(self, sd_map, *inputs):
        tokens, valid = SdMapEncoder(MODULE, RANGE, name="sd_map")(sd_map)
        return self.encoder(*inputs, fuse=fused_with(MODULE, tokens, valid) if self.fuses else None)


def evidence():
    raster = np.random.default_rng(2).integers(0, 256, (8, 16, 4), np.uint8)
    return EvidenceEncoder(EvidenceEncoderConfig(8, 4, (1, 2))), (raster,)


def cameras():
    return BevFormer(replace(CONFIG, remat=True)), (levels(), ring(), None, jnp.eye(4))


@pytest.mark.parametrize(
    ("make", "layers"), [(evidence, 2), pytest.param(cameras, 1, marks=pytest.mark.slow)], ids=["evidence", "cameras"]
)
def test_encoders_fuse_the_map_in_every_layer(make, layers):
    encoder, inputs = make()
    fused, plain = Fused(encoder), Fused(encoder, fuses=False)
    params = random_params(fused.init, NO_MAP, *inputs)
    own = {path for path, _ in jax.tree.leaves_with_path(params)}
    found = {key.key for path in own for key in path if key.key.startswith("sd_map_")}
    assert found == {f"sd_map_{i}" for i in range(layers)}

    @jax.jit
    def run(params, sd_map):
        def scalar(params):
            out = fused.apply(params, sd_map, *inputs)
            return jnp.square(out).sum(), out

        (_, out), gradients = jax.value_and_grad(scalar, has_aux=True)(params)
        return out, gradients

    out, gradients = run(params, small_map(filler=np.nan))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert all(
        np.asarray(leaf).any()
        for path, leaf in jax.tree.leaves_with_path(gradients)
        if any(key.key.startswith("sd_map") for key in path)
        and "key/bias" not in jax.tree_util.keystr(path, simple=True, separator="/")
    )
    absent, gradients = run(params, small_map(np.zeros(3, bool), np.nan))
    assert np.abs(out - absent).max() > 0.05
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    # A host without a map, with the parameters that both have in common.
    without = jax.jit(lambda p: plain.apply(p, NO_MAP, *inputs))(params)
    np.testing.assert_allclose(absent, without, atol=1e-5)


def test_paper_size_has_the_published_parameters():
    module = SdMapModuleConfig()
    tokens, valid = jnp.zeros((2, 256)), jnp.ones(2, bool)
    encoder = jax.eval_shape(SdMapEncoder(module, RANGE).init, jax.random.key(0), NO_MAP)
    assert sum(leaf.size for leaf in jax.tree.leaves(encoder)) == 2_467_072
    config = BevFormerConfig(grid=BevGrid(), levels=1, cameras=2)
    views = jax.tree.map(jnp.asarray, ring(2, (32, 32)))
    init = lambda fuse: jax.eval_shape(  # noqa: E731
        lambda f: BevFormer(config).init(jax.random.key(0), f, views, None, jnp.eye(4), fuse=fuse),
        [jax.ShapeDtypeStruct((2, 4, 4, 256), jnp.float32)],
    )
    fuses = (fused_with(module, tokens, valid), None)
    sizes = [sum(leaf.size for leaf in jax.tree.leaves(init(fuse))) for fuse in fuses]
    assert sizes[0] - sizes[1] == 8_458_688 - 7_667_648


def test_map_coordinates_are_normalised_by_the_range_of_the_host():
    """The same road seen from two places is the same road: normalised by the range of the host."""
    wide = PerceptionRange((-20.0, 20.0), (-10.0, 10.0))
    encoder = SdMapEncoder(MODULE, wide)
    params = random_params(encoder.init, NO_MAP)
    half = small_map()
    double = SdMapEncoder(MODULE, PerceptionRange((-40.0, 40.0), (-20.0, 20.0)))
    tokens, _ = jax.jit(encoder.apply)(params, half)
    scaled, _ = jax.jit(double.apply)(params, half.replace(points=2 * half.points))
    np.testing.assert_allclose(tokens, scaled, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("absent", ["nothing", "reference"])
def test_a_host_of_any_number_of_points_reads_examples_without_a_map(absent):
    """As a map whose lines are all invalid; the parameters depend on the number of points.

    The host without the prior gives the same bits, unless the fusion normalises as in the reference.
    """
    sd_map = replace(MODULE, absent=absent, radius=5.0)
    task = LaneGraphTask(replace(BASELINE, priors=PriorsConfig(sd_map=sd_map)))
    example = make_example()
    nothing = example.replace(sd_map=SdMap.empty(3, 21))
    params = random_params(task.init, nothing)
    predict = jax.jit(task.predict)
    expected, found = (predict(params, one).centerlines for one in (nothing, example))
    jax.tree.map(np.testing.assert_array_equal, expected, found)
    without = jax.jit(LaneGraphTask(BASELINE).predict)(params, example).centerlines
    same = jax.tree.map(np.array_equal, without, found)
    assert all(jax.tree.leaves(same)) == (absent == "nothing")
