"""Marker fusion: tokens, gate, variants, and a host that absent markers leave unchanged."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.models.cases import BASELINE, CAMERA_TOPONET, WITH_TRAFFIC, make_camera_example, make_example
from tests.parameters import random_params
from tests.shared import assert_same
from tests.slow import with_slow
from tflane_jax.layers.masks import key_mask
from tflane_jax.layers.polyline_encoder import PolylineEncoderConfig
from tflane_jax.models.marker_fusion import (
    LaneNeighbours,
    MarkerEncoder,
    MarkerFusion,
    MarkerFusionConfig,
    MarkerPrior,
    as_fused,
    as_written,
    fusion_mask,
    uniform_fusion,
)
from tflane_jax.models.sd_map_encoder import SMALL_SD_MAP
from tflane_jax.priors.marker_memory import MarkerMemoryConfig
from tflane_jax.priors.markers import MarkerPriorConfig
from tflane_jax.scene import MarkerObservations, SdMap, stack_examples
from tflane_jax.tasks.lane_graph import LaneGraphTask

LINES = PolylineEncoderConfig(
    dim=8, layers=1, heads=2, hidden=8, dropout=0.0, bands=4, layout="interleaved", attend="points"
)
CONFIG = MarkerFusionConfig(
    prior=MarkerPriorConfig(points=3, lanes=4),
    lines=LINES,
    heads=2,
    memory=MarkerMemoryConfig(frames=3, decay=0.5, threshold=0.05),
)


def lanes_of(example):
    """Return the marker lanes of a frame without memory."""
    return CONFIG.build(BASELINE.spec).observe(example, None)[0]


HOST = LaneGraphTask(replace(BASELINE, priors=replace(BASELINE.priors, markers=CONFIG)))
PLAIN = LaneGraphTask(BASELINE)
POSE = np.array([[1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float32)


def observed(distance=10.0, lanes=2, seed=0, garbage=0.0, valid=True):
    """Return one marker with some lanes, and room for another."""
    rng, out = np.random.default_rng(seed), MarkerObservations.empty(2, 3, 5)
    out.pose[:], out.lanes[:], out.residual[:], out.score[:] = garbage, garbage, garbage, garbage
    if valid:
        out.pose[0] = np.eye(4)
        out.pose[0, 0, 3] = distance
        out.residual[0], out.score[0], out.valid[0] = 0.0, 1.0, True
        out.lane_valid[0, :lanes] = True
        out.lanes[0, :lanes] = rng.uniform(-20, 20, (lanes, 5, 3))
        out.successor[0, 0, 1] = lanes > 1
    return out


def seeing(markers, seed=0, **changes):
    return make_example(seed).replace(markers=markers, previous_from_ego=POSE, **changes)


@pytest.fixture(scope="module")
def params():
    return random_params(HOST.init, seeing(observed()))


@pytest.fixture(scope="module")
def step():
    return jax.jit(HOST.step)


def without_markers(params):
    """Return the parameters without those of marker fusion."""
    if not isinstance(params, dict):
        return params
    return {name: without_markers(value) for name, value in params.items() if not name.startswith("marker")}


@pytest.mark.slow
def test_without_markers_in_sight_the_host_is_unchanged(params, step):
    expected = jax.jit(PLAIN.step)(without_markers(params), PLAIN.start(), make_example(0))[1]
    for markers in (None, observed(valid=False), observed(valid=False, garbage=np.nan), observed(lanes=0)):
        assert_same(step(params, HOST.start(), seeing(markers, has_previous=np.asarray(False)))[1], expected)
        assert_same(jax.jit(HOST.predict)(params, seeing(markers)), expected)
    guided = step(params, HOST.start(), seeing(observed()))[1]
    assert not np.array_equal(guided.centerlines.points, expected.centerlines.points)


@pytest.mark.slow
def test_cameras_may_have_markers_too():
    model = replace(CAMERA_TOPONET, decoder=replace(CAMERA_TOPONET.decoder, dropout=0.0))
    plain, host = LaneGraphTask(model), LaneGraphTask(replace(model, priors=replace(model.priors, markers=CONFIG)))
    example = make_camera_example()
    params = random_params(host.init, example)
    expected = jax.jit(plain.predict)(without_markers(params), example)
    predict = jax.jit(host.predict)
    assert_same(predict(params, example.replace(markers=observed(valid=False, garbage=np.nan))), expected)
    guided = predict(params, example.replace(markers=observed()))
    assert not np.array_equal(guided.centerlines.points, expected.centerlines.points)
    assert np.isfinite(guided.centerlines.points).all()


def test_every_layer_of_the_bev_encoder_has_a_fusion_of_its_own():
    encoder = replace(BASELINE.encoder, dilations=(1, 2))
    priors = replace(BASELINE.priors, markers=CONFIG, sd_map=SMALL_SD_MAP)
    host = LaneGraphTask(replace(BASELINE, encoder=encoder, priors=priors))
    shapes = jax.eval_shape(host.init, jax.random.key(0), seeing(observed()))
    assert {f"{prior}_{layer}" for prior in ("markers", "sd_map") for layer in (0, 1)} <= shapes["encoder"].keys()


def test_traffic_flow_markers_and_sd_map_work_in_one_model():
    rng = np.random.default_rng(3)
    sd_map = SdMap(rng.uniform(-20, 20, (3, 11, 2)).astype(np.float32), np.zeros(3, np.int32), np.ones(3, bool))
    every = LaneGraphTask(
        replace(WITH_TRAFFIC, priors=replace(WITH_TRAFFIC.priors, markers=CONFIG, sd_map=SMALL_SD_MAP))
    )
    seen = seeing(observed()).replace(sd_map=sd_map)
    params = random_params(every.init, seen)
    predict = jax.jit(every.predict)
    whole = predict(params, seen).centerlines.points
    assert np.isfinite(whole).all()
    absent = {
        "markers": seen.markers.replace(valid=np.zeros_like(seen.markers.valid)),
        "sd_map": sd_map.replace(valid=np.zeros(3, bool)),
        "traffic_flow": jax.tree.map(np.zeros_like, seen.traffic_flow),
    }
    for name, nothing in absent.items():
        assert not np.array_equal(predict(params, seen.replace(**{name: nothing})).centerlines.points, whole), name


def test_padding_may_hold_nan(params, step):
    clean, dirty = (seeing(observed(garbage=value)) for value in (0.0, np.nan))
    assert_same(step(params, HOST.start(), clean), step(params, HOST.start(), dirty))
    gradient = jax.jit(jax.grad(lambda p, e: HOST.loss(p, e, jax.random.key(0))[0]))
    batches = [jax.tree.map(jnp.asarray, stack_examples([example])) for example in (clean, dirty)]
    first, second = (gradient(params, batch) for batch in batches)
    assert_same(first, second)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(first))
    assert np.abs(first["marker_tokens"]["lines"]["embed"]["kernel"]).max() > 0


def test_stream_equals_scan_and_visibility_causes_no_retrace(params):
    traces = []

    @jax.jit
    def one(memory, example):
        traces.append(None)
        return HOST.step(params, memory, example)

    patterns = (True, False, False, False, False), (False, True, True, False, True)
    for pattern in patterns:
        frames = [
            seeing(observed(seed=i, valid=seen), i, has_previous=np.asarray(i > 0)) for i, seen in enumerate(pattern)
        ]
        memory, answers = HOST.start(), []
        for frame in frames:
            memory, answer = one(memory, frame)
            answers.append(answer)
        scan = jax.jit(lambda frames: lax.scan(partial(HOST.step, params), HOST.start(), frames))
        last, scanned = scan(jax.tree.map(jnp.asarray, stack_examples(frames)))
        assert_same(last, memory)
        assert_same(scanned, jax.tree.map(lambda *leaves: np.stack(leaves), *answers))
    assert len(traces) == 1


def test_memory_bridges_a_gap_up_to_the_length_of_the_bank(params, step):
    gap = [seeing(None, i, has_previous=np.asarray(True)) for i in range(1, 4)]
    memory = step(params, HOST.start(), seeing(observed()))[0]
    differs = []
    for frame in gap:
        memory, answer = step(params, memory, frame)
        alone = step(params, HOST.start(), frame)[1]
        differs.append(not np.array_equal(answer.centerlines.points, alone.centerlines.points))
    assert differs == [True, True, False]


def fused(config, guide, bev, position):
    module, lanes = MarkerFusion(config), as_fused(guide, config)
    tokens = jnp.asarray(np.random.default_rng(1).normal(size=(len(guide.valid), 8)), jnp.float32)
    arguments = bev, position, tokens, key_mask(lanes.valid), lanes.gate
    variables = random_params(lambda key: module.init(key, *arguments))
    return module.apply(variables, *arguments), variables, tokens


def test_the_gate_is_the_confidence_and_its_variants():
    rng = np.random.default_rng(0)
    bev, position = (jnp.asarray(rng.normal(size=(5, 8)), jnp.float32) for _ in range(2))
    near, far = (lanes_of(seeing(observed(d))) for d in (10.0, 80.0))
    np.testing.assert_allclose([near.gate, far.gate], np.exp([-0.25, -2.0]), rtol=1e-5)
    out, variables, tokens = fused(CONFIG, near, bev, position)
    variables = jax.tree.map(np.asarray, variables)
    attention = variables["params"]["attention"]

    def heads(x, name):
        return (x @ attention[name]["kernel"] + attention[name]["bias"]).reshape(len(x), 2, 4).transpose(1, 0, 2)

    seen = np.asarray(tokens)[np.asarray(near.valid)]
    q, k, v = heads(np.asarray(bev + position), "query"), heads(seen, "key"), heads(seen, "value")
    weights = np.exp(q @ k.transpose(0, 2, 1) / 2)
    weights /= weights.sum(-1, keepdims=True)
    found = (weights @ v).transpose(1, 0, 2).reshape(5, 8) @ attention["output"]["kernel"]
    total = np.asarray(bev) + np.exp(-0.25) * (found + attention["output"]["bias"])  # Eq. (3)
    normed = (total - total.mean(-1, keepdims=True)) / np.sqrt(total.var(-1, keepdims=True) + 1e-5)
    norm = variables["params"]["norm"]
    np.testing.assert_allclose(out, normed * norm["scale"] + norm["bias"], atol=1e-4)

    uniform, hard = (replace(CONFIG, fusion=kind) for kind in ("uniform", "hard"))
    assert_same(fused(uniform, near, bev, position)[0], fused(uniform, far, bev, position)[0])
    assert_same(fused(hard, near, bev, position)[0], fused(uniform, near, bev, position)[0])
    assert_same(fused(hard, far, bev, position)[0], bev)
    assert not np.array_equal(out, fused(CONFIG, far, bev, position)[0])


def test_hard_masking_looks_at_each_marker():
    """A distrusted marker beside a trusted one is ignored, and so are lanes whose remembered confidence has decayed."""
    both = observed(10.0)
    for name in ("pose", "lanes", "lane_valid", "valid"):
        getattr(both, name)[1] = getattr(both, name)[0]
    both.residual[:] = 0.0, 30.0
    hard = replace(CONFIG, fusion="hard")
    prior = MarkerPrior(hard, BASELINE.spec)
    guide, bank = prior.observe(seeing(both), prior.start())
    np.testing.assert_allclose(guide.confidence[:4], np.exp([-0.25, -0.25, -3.25, -3.25]), rtol=1e-5)
    lanes = as_fused(guide, hard)
    assert lanes.gate == 1.0
    np.testing.assert_array_equal(np.flatnonzero(guide.valid), [0, 1, 2, 3])
    np.testing.assert_array_equal(np.flatnonzero(lanes.valid), [0, 1])
    # One frame later 0.39 is left of 0.78, below the threshold of 0.5.
    gap, _ = prior.observe(seeing(None, has_previous=np.asarray(True)), bank)
    assert gap.valid.any()
    np.testing.assert_allclose(gap.confidence.max(), 0.5 * np.exp(-0.25), rtol=1e-5)
    assert not as_fused(gap, hard).valid.any()
    assert as_fused(gap, replace(hard, hard_threshold=0.3)).valid.sum() == 2


def test_as_written_the_norm_applies_without_markers_too():
    config = as_written(replace(CONFIG, width=16, radius=2.0, norm="query"))
    assert (config.norm, config.width, config.radius, config.query_position) == ("written", None, None, False)
    assert config.memory == CONFIG.memory
    rng = np.random.default_rng(0)
    bev, position = (jnp.asarray(rng.normal(size=(5, 8)), jnp.float32) for _ in range(2))
    near = lanes_of(seeing(observed(10.0)))
    nothing = near.replace(valid=jnp.zeros_like(near.valid), gate=jnp.zeros(()))
    assert_same(fused(config, near, bev, position)[0], fused(config, near, bev, position + 1.0)[0])
    out, variables, _ = fused(config, nothing, bev, position)
    norm = jax.tree.map(np.asarray, variables["params"]["norm"])
    expected = np.asarray(bev - bev.mean(-1, keepdims=True)) / np.sqrt(np.asarray(bev.var(-1))[:, None] + 1e-5)
    np.testing.assert_allclose(out, expected * norm["scale"] + norm["bias"], atol=1e-4)
    assert_same(fused(replace(config, norm="sum"), nothing, bev, position)[0], bev)


def test_uniform_fusion_knows_no_confidence():
    """Near or far, still or jumped: the same tokens, gate and memory."""
    config = uniform_fusion(CONFIG)
    near, far = observed(10.0), observed(70.0)
    jumped = far.replace(residual=np.full_like(far.residual, 25.0))
    prior = MarkerPrior(config, BASELINE.spec)
    guides = [prior.observe(seeing(markers), prior.start())[0] for markers in (near, far, jumped)]
    for guide in guides:
        assert guide.gate == 1.0
        np.testing.assert_array_equal(guide.weight, guide.valid.astype(np.float32))
    ungated = MarkerPrior(replace(CONFIG, fusion="uniform"), BASELINE.spec)
    assert ungated.observe(seeing(jumped), None)[0].gate < 0.1  # memory would be read instead
    # Remembered lanes count fully, and only where nothing is detected.
    _, bank = prior.observe(seeing(far), prior.start())
    gap = prior.observe(seeing(None).replace(has_previous=np.asarray(True)), bank)[0]
    assert gap.gate == 1.0
    np.testing.assert_array_equal(gap.weight, gap.valid.astype(np.float32))
    assert gap.valid.any()


def test_a_zero_initialised_fusion_leaves_the_trained_host_unchanged():
    module = MarkerFusion(replace(CONFIG, norm="query", width=16))
    bev, position, tokens = (jnp.asarray(np.random.default_rng(i).normal(size=(5, 8)), jnp.float32) for i in range(3))
    arguments = bev, position, tokens, jnp.ones((1, 5), bool)
    assert_same(module.apply(module.init(jax.random.key(0), *arguments, 0.7), *arguments, 0.7), bev)
    learned = random_params(lambda key: module.init(key, *arguments, 0.7))
    change, half = (module.apply(learned, *arguments, gate) - bev for gate in (0.7, 0.35))
    assert np.abs(change).max() > 1e-3
    np.testing.assert_allclose(half, change / 2, rtol=1e-4, atol=1e-6)


def test_cells_beyond_the_radius_of_all_lanes_are_unchanged():
    guide, config = lanes_of(seeing(observed())), replace(CONFIG, radius=1.0, norm="query")
    start = guide.points[int(np.argmax(guide.valid)), 0]
    mask = fusion_mask(guide, jnp.stack([start, start + 500.0]), config)
    np.testing.assert_array_equal(mask.any(1), [True, False])
    tokens = jnp.asarray(np.random.default_rng(1).normal(size=(len(guide.valid), 8)), jnp.float32)
    arguments, module = (jnp.ones((2, 8)), jnp.zeros((2, 8)), tokens, mask, guide.gate), MarkerFusion(config)
    out = module.apply(random_params(lambda key: module.init(key, *arguments)), *arguments)
    assert_same(out[1], jnp.ones(8))
    assert not np.array_equal(out[0], jnp.ones(8))


@pytest.mark.parametrize("encoding", with_slow(["sine", "transformer", "mlp"], quick=["sine"]))
@pytest.mark.parametrize("connectivity", [False, True])
def test_tokens_are_scaled_and_belong_to_their_lane(encoding, connectivity):
    module = MarkerEncoder(replace(CONFIG, encoding=encoding, connectivity=connectivity), BASELINE.spec.bev_range)
    guide = lanes_of(seeing(observed()))
    variables = random_params(module.init, guide)
    tokens = np.asarray(module.apply(variables, guide))
    assert tokens.shape == (4, 8)
    np.testing.assert_array_equal(tokens[2:], 0.0)
    half = module.apply(variables, guide.replace(weight=0.5 * guide.weight))
    np.testing.assert_allclose(half, 0.5 * tokens, rtol=1e-6)
    # Moving the second lane changes the first one's token only along an edge.
    moved = guide.replace(points=guide.points.at[1].add(3.0))
    changed = np.asarray(module.apply(variables, moved))
    assert not np.allclose(changed[1], tokens[1])
    assert np.array_equal(changed[0], tokens[0]) != connectivity


@pytest.mark.parametrize("encoding", ["transformer", "mlp"])
def test_only_the_transformer_models_interactions_of_points(encoding):
    """Table IV: without interactions, moving two points of a line changes the sum of what moving each changes."""
    module = MarkerEncoder(replace(CONFIG, encoding=encoding), BASELINE.spec.bev_range)
    guide = lanes_of(seeing(observed()))
    variables = random_params(module.init, guide)
    first, last = (jnp.zeros_like(guide.points).at[0, i].set(3.0) for i in (0, -1))
    both, one, other, neither = (
        np.asarray(module.apply(variables, guide.replace(points=guide.points + moved)), np.float64)[0]
        for moved in (first + last, first, last, jnp.zeros_like(first))
    )
    assert np.abs(one - neither).max() > 1e-3
    assert (np.abs(both - one - other + neither).max() < 1e-5) == (encoding == "mlp")


def test_messages_follow_the_direction_of_edges():
    module, tokens = LaneNeighbours(8), jnp.eye(4, 8)
    edges = np.zeros((4, 4), bool)
    edges[0, 1] = edges[0, 2] = True
    variables = random_params(module.init, tokens, edges)
    out = np.asarray(module.apply(variables, tokens, edges))
    after, before = (np.asarray(variables["params"][name]["kernel"]) for name in ("successors", "predecessors"))
    expected = np.asarray(tokens).copy()
    expected[0] += (after[1] + after[2]) / 2
    expected[1:3] += before[0]
    np.testing.assert_allclose(out, expected, rtol=1e-5)
