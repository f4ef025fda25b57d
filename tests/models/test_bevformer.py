"""BEVFormer's encoder: memory, streaming, cameras, sizes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.parameters import random_params
from tests.slow import with_slow
from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.geometry.poses import yaw_pose
from tflane_jax.models.bevformer import (
    BevFormer,
    BevFormerConfig,
    BevMemory,
    check_capacity,
    see_pillars,
    seen_queries,
)
from tflane_jax.scene import CameraViews


@pytest.mark.slow
def test_paper_size_has_the_published_parameters():
    shapes = ((100, 128), (50, 64), (25, 32), (13, 16))
    levels = [jax.ShapeDtypeStruct((7, *shape, 256), jnp.float32) for shape in shapes]
    views = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, ring(7, (800, 1024))))
    for config in (BevFormerConfig(), BevFormerConfig(capacity=6000, remat=True, precision="bfloat16")):
        model = BevFormer(config)
        out, fresh = jax.eval_shape(
            lambda *a, m=model: m.init_with_output(jax.random.key(0), *a, None, jnp.eye(4)), levels, views
        )
        assert sum(leaf.size for leaf in jax.tree.leaves(fresh)) == 7_667_648
        assert out.shape == (100, 200, 256)
        assert {leaf.dtype for leaf in jax.tree.leaves((fresh, out))} == {np.dtype("float32")}


GRID = BevGrid(PerceptionRange((-10.0, 10.0), (-5.0, 5.0), (-2.0, 2.0)), 5, 10)
CONFIG = BevFormerConfig(GRID, 8, 2, 1, 16, 0.0, 2, 4, anchors=2, levels=2, cameras=3)
MODEL = BevFormer(CONFIG)


@pytest.mark.parametrize("initial", with_slow(["mixed", "xavier", "normal"], quick=["xavier"]))
def test_queries_and_positions_start_as_published(initial):
    grid = BevGrid(GRID.range, 20, 40)
    model = BevFormer(replace(CONFIG, grid=grid, initial=initial))
    fresh = jax.jit(lambda: model.init(jax.random.key(0), levels(), ring(), None, jnp.eye(4)))()["params"]
    tables = fresh["queries"], fresh["position"]["row"], fresh["position"]["column"]
    for table, mean in zip(tables, (0.0, 0.5, 0.5), strict=True):
        uniform = initial == "xavier" or (initial == "mixed" and mean)
        if not uniform:
            np.testing.assert_allclose((table.mean(), table.std()), (0.0, 1.0), atol=0.25)
            continue
        # Within +-bound about the mean; Xavier: the root of 6 / (rows + columns).
        bound = np.sqrt(6.0 / sum(table.shape)) if initial == "xavier" else 0.5
        apart = np.abs(table - (0.0 if initial == "xavier" else mean)).max()
        assert 0.8 * bound < apart <= bound
    np.testing.assert_allclose(fresh["cameras"].std(), 1.0, atol=0.35)


def ring(cameras=3, shape=(48, 64)):
    """Return cameras that look evenly around, 1.5 m above the ground."""
    height, width = shape
    ahead = np.array([[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    turns = [ahead @ yaw_pose(0.0, 0.0, -2 * np.pi * i / cameras) for i in range(cameras)]
    k = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]], np.float32)
    size = np.tile([width, height], (cameras, 1)).astype(np.int32)
    return CameraViews(
        np.zeros((cameras, *shape, 3), np.uint8),
        size,
        np.tile(k, (cameras, 1, 1)),
        np.stack(turns).astype(np.float32),
        np.ones(cameras, bool),
    )


def levels(seed=0, cameras=3):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(cameras, h, w, 8)).astype(np.float32) for h, w in ((6, 8), (3, 4))]


@pytest.fixture(scope="module")
def variables():
    fresh = jax.jit(lambda: MODEL.init(jax.random.key(0), levels(), ring(), None, jnp.eye(4)))()
    # Not the initial zeros, so that offsets and attention weights depend on the query.
    leaves, tree = jax.tree.flatten(fresh)
    rng = np.random.default_rng(1)
    return jax.tree.unflatten(tree, [leaf + 0.1 * rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves])


@pytest.fixture(scope="module")
def encode(variables):
    return jax.jit(lambda *arguments: MODEL.apply(variables, *arguments))


@pytest.fixture(scope="module")
def memory():
    return BevMemory(np.random.default_rng(3).normal(size=(5, 10, 8)).astype(np.float32), np.array(True))


POSE = yaw_pose(np.float32(1.5), np.float32(-0.3), np.float32(0.2)).astype(np.float32)


@pytest.mark.slow
def test_a_valid_memory_changes_the_features_and_an_invalid_one_does_not(encode, variables, memory):
    with_memory = encode(levels(), ring(), memory, POSE)
    nothing = encode(
        levels(), ring(), BevMemory(np.full((5, 10, 8), np.nan, np.float32), np.array(False)), POSE * np.nan
    )
    without = jax.jit(lambda *a: MODEL.apply(variables, *a[:2], None, a[2]))(levels(), ring(), POSE)
    np.testing.assert_array_equal(nothing, without)
    assert np.abs(with_memory - without).max() > 0.05


def test_streaming_equals_the_scan_bit_for_bit(variables, encode):
    def stacked(make):
        return jax.tree.map(lambda *leaves: np.stack(leaves), *[make(t) for t in range(4)])

    def step(memory, frame):
        features, views, pose, has_previous = frame
        bev = MODEL.apply(variables, features, views, memory.replace(valid=memory.valid & has_previous), pose)
        return BevMemory(bev, jnp.ones((), bool)), bev

    frames = stacked(levels), stacked(lambda t: ring()), np.stack([POSE] * 4), np.array([False, True, True, False])
    start = BevMemory.empty(CONFIG)
    scanned = np.asarray(jax.jit(lambda frames: jax.lax.scan(step, start, frames)[1])(frames))
    one, carry = jax.jit(step), start
    for t in range(4):
        carry, bev = one(carry, jax.tree.map(lambda leaf, t=t: leaf[t], frames))
        np.testing.assert_array_equal(bev, scanned[t])
    none = BevMemory.empty(CONFIG)
    alone = encode(levels(3), ring(), none, POSE)
    np.testing.assert_allclose(scanned[3], alone, atol=1e-5)
    assert np.abs(scanned[2] - encode(levels(2), ring(), none, POSE)).max() > 0.05


def test_cameras_have_no_order_but_their_own_embedding(encode, variables, memory):
    out = encode(levels(), ring(), memory, POSE)
    order = np.array([2, 0, 1])
    params = variables["params"] | {"cameras": variables["params"]["cameras"][order]}
    shuffled = jax.tree.map(lambda leaf: leaf[order], ring())
    other = jax.jit(lambda *a: MODEL.apply({"params": params}, *a))
    same = other([level[order] for level in levels()], shuffled, memory, POSE)
    np.testing.assert_allclose(same, out, atol=2e-5)


def test_an_invalid_camera_may_hold_anything(encode, memory):
    views = ring()
    gone = views.replace(valid=np.array([True, False, True]))
    garbage = gone.replace(
        intrinsics=np.where(gone.valid[:, None, None], views.intrinsics, np.nan),
        camera_from_ego=np.where(gone.valid[:, None, None], views.camera_from_ego, np.nan),
        size=np.where(gone.valid[:, None], views.size, 0),
    )
    bad = [np.where(gone.valid[:, None, None, None], level, np.nan).astype(np.float32) for level in levels()]
    clean = encode(levels(), gone, memory, POSE)
    np.testing.assert_array_equal(clean, encode(bad, garbage, memory, POSE))
    assert np.isfinite(clean).all()
    assert np.abs(clean - encode(levels(), views, memory, POSE)).max() > 0.05


@pytest.mark.parametrize(
    "change", [{"capacity": 20, "remat": True}, {"attention": "kernel", "levels": 1}], ids=["deformable", "kernel"]
)
@pytest.mark.slow
def test_gradients_do_not_depend_on_what_padding_holds(change):
    config = replace(CONFIG, **change)
    model, views = BevFormer(config), ring().replace(valid=np.array([True, False, True]))
    features, pose = levels()[: config.levels], np.eye(4, dtype=np.float32)
    params = random_params(model.init, features, views, None, pose)

    @jax.jit
    def learn(features, views, memory, pose):
        loss = lambda p, f: jnp.square(model.apply(p, f, views, memory, pose)).sum()  # noqa: E731
        return jax.value_and_grad(loss, (0, 1))(params, features)

    clean = learn(features, views, BevMemory(np.zeros((5, 10, 8), np.float32), np.array(False)), pose)
    soiled = views.replace(camera_from_ego=np.where(views.valid[:, None, None], views.camera_from_ego, np.nan))
    bad = [np.where(views.valid[:, None, None, None], level, np.nan).astype(np.float32) for level in features]
    empty = BevMemory(np.full((5, 10, 8), np.nan, np.float32), np.array(False))
    jax.tree.map(np.testing.assert_array_equal, learn(bad, soiled, empty, pose * np.nan), clean)
    by_params, by_features = clean[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_params))
    assert np.abs(by_features[0][0]).max() > 0
    assert not np.asarray(by_features[0][1]).any()


@pytest.mark.slow
def test_capacity_and_rematerialisation_change_no_number(encode, variables, memory):
    most = int(seen_queries(CONFIG, ring()).max())
    assert 5 < most < 50
    config = replace(CONFIG, capacity=most, remat=True)
    check_capacity(config, ring())
    compact = jax.jit(lambda *a: BevFormer(config).apply(variables, *a))(levels(), ring(), memory, POSE)
    np.testing.assert_allclose(compact, encode(levels(), ring(), memory, POSE), atol=2e-5)
    with pytest.raises(UserError, match=f"a camera sees {most} cells"):
        check_capacity(replace(config, capacity=most - 1), ring())


def test_levels_and_cameras_must_fit_the_configuration(variables):
    for features, views in ((levels()[:1], ring()), (levels(cameras=4), ring(4))):
        with pytest.raises(UserError, match="2 levels of at most 3 cameras"):
            jax.eval_shape(MODEL.apply, variables, features, views, None, np.eye(4, dtype=np.float32))


def test_smaller_images_lie_in_the_corner_of_their_array():
    """In an array twice as wide and high, the same pixels have half the normalised coordinates."""
    views = ring()
    reference, visible = see_pillars(CONFIG, views)
    larger = views.replace(image=np.zeros((3, 96, 128, 3), np.uint8))
    halved, same = see_pillars(CONFIG, larger)
    np.testing.assert_array_equal(same, visible)
    np.testing.assert_allclose(2 * halved, reference, rtol=1e-6)
    # Published code also sees what lies over the padding, at the same places; or takes the image for the whole array.
    places, more = see_pillars(replace(CONFIG, image_size="array"), larger)
    np.testing.assert_allclose(places, halved, rtol=1e-6)
    assert (np.asarray(more) >= same).all()
    assert more.sum() > same.sum()
    narrow = larger.replace(size=np.array([[32, 48], [64, 48], [64, 48]], np.int32))
    stretched, fewer = see_pillars(replace(CONFIG, image_size="first"), narrow)
    np.testing.assert_allclose(stretched, np.asarray(reference) * np.array([2.0, 1.0], np.float32), rtol=1e-6)
    inside = ((stretched > 0.0) & (stretched < 1.0)).all(-1)
    np.testing.assert_array_equal(fewer, inside & np.asarray(visible))
