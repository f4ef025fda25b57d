"""The lift of image features into BEV against the reference's numbers; geometry, borders, cameras."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

from tests.golden import case_id, golden_modules, load_module_case, options
from tests.golden_compare import compare
from tests.parameters import random_params
from tflane_jax.convert.maptr import LIFT
from tflane_jax.convert.renaming import convert
from tflane_jax.errors import UserError
from tflane_jax.geometry import BevGrid, PerceptionRange, yaw_pose
from tflane_jax.layers.depth_net import DepthNet
from tflane_jax.limits import check_settings
from tflane_jax.losses.map_masks import depth_targets
from tflane_jax.losses.maptrv2 import depth_loss
from tflane_jax.models.auxiliary import LineMaskHead
from tflane_jax.models.lift import LiftConfig, LiftEncoder, camera_vector, cell_numbers, collect, ray_points
from tflane_jax.models.raster_fusion import RasterFusion, TrafficRasterConfig
from tflane_jax.priors.traffic_raster import CHANNELS, TrafficRaster
from tflane_jax.scene import CameraViews, VehicleState


@pytest.mark.golden
@pytest.mark.parametrize("path", golden_modules("maptrv2_lss_transform*"), ids=case_id)
def test_it_matches_the_reference(path):
    case = load_module_case(path)
    sizes = ("dim", "pc_range", "voxel_size", "dbound", "downsample", "aspp_mid_channels", "loss_depth_weight")
    found = options(case, *sizes, "feat_down_sample")
    low, high = np.array(found.pc_range).reshape(2, 3)
    columns, rows, _ = np.rint((high - low) / found.voxel_size).astype(int).tolist()
    config = LiftConfig(
        BevGrid(PerceptionRange(*zip(low, high, strict=True)), rows // found.downsample, columns // found.downsample),
        fine=found.downsample,
        dim=found.dim,
        depth=tuple(found.dbound),
        pyramid=found.aspp_mid_channels,
        border="published",
    )
    inputs = case.inputs
    size, shape = tuple(inputs["img_hw"].tolist()), inputs["images"].shape[-2:]
    assert size == tuple(found.feat_down_sample * n for n in shape)
    # Matrices of the images as they are, and from the lidar's frame, which is that of the BEV features.
    augmented = inputs["img_aug_matrix"]
    affine = augmented[..., :3, :3].copy()
    affine[..., :2, 2] += augmented[..., :2, 3]
    intrinsics = affine @ inputs["camera_intrinsics"][..., :3, :3]
    pose = np.linalg.inv(inputs["camera2ego"].astype(np.float64)) @ inputs["lidar2ego"].astype(np.float64)[:, None]
    place = jax.vmap(lambda k, p: ray_points(k, p, size, shape, config.depth))
    points = jax.jit(place)(jnp.asarray(intrinsics), jnp.asarray(pose, jnp.float32))
    # What the depth network knows of the cameras, from their calibration.
    native, known = inputs["camera_intrinsics"][..., :2, :3], jnp.asarray(affine[..., :2, :])
    vectors = jax.jit(jax.vmap(camera_vector))(native, known, jnp.asarray(np.linalg.inv(inputs["camera2ego"])))
    one_hot = case.outputs["gt_depth_onehot"].reshape(*points.shape[:2], *shape, config.bins)
    bins, counted = one_hot.argmax(-1), one_hot.any(-1)

    def outputs(torch_params, arrays):
        variables = convert(torch_params, LIFT, "LSS").variables

        def one(features, vector, points):
            model = LiftEncoder(config)
            return model.apply(variables, features, vector, points, train=False, method="encode")

        features = jnp.asarray(arrays["images"]).transpose(0, 1, 3, 4, 2)
        bev, logits = jax.vmap(one)(features, vectors, points)
        loss = depth_loss(logits, bins, counted)
        return {
            "bev": bev.transpose(0, 3, 1, 2),
            "depth": jax.nn.softmax(logits, -1).transpose(0, 1, 4, 2, 3),
            "geom": points,
            "mlp_input": vectors,
            "depth_loss": found.loss_depth_weight * loss,
        }

    statistics = {name: x for name, x in case.params.items() if name.endswith(("running_mean", "running_var"))}
    constant = {name: case.params[name] for name in ("dx", "bx", "nx")}
    learned = {name: x for name, x in case.params.items() if name not in statistics and name not in constant}
    tolerances = {"geom": 1e-4, "bev": 1e-4}
    run = lambda params, arrays: outputs(params | statistics | constant, arrays)  # noqa: E731
    compare(case, run, params=learned, ignore=("gt_depth_onehot",), tolerances=tolerances)
    # Its bins are ours, but that a point nearer than the first bin hides all others in its cell.
    ours, valid = jax.vmap(lambda depth: targets_of(depth, shape, config.depth))(inputs["gt_depth"])
    near = (inputs["gt_depth"] > 0) & (inputs["gt_depth"] < config.depth[0])
    factor = size[0] // shape[0]
    clear = ~near.reshape(*near.shape[:2], shape[0], factor, shape[1], factor).any((3, 5))
    assert clear.any()
    np.testing.assert_array_equal(np.asarray(valid)[clear], counted[clear])
    np.testing.assert_array_equal(np.asarray(ours)[clear & counted], bins[clear & counted])


def targets_of(depth, shape, bounds):
    """Return the depth targets of the images of one example; 0 is no depth."""
    count = len(depth)
    views = CameraViews(
        np.zeros((count, *depth.shape[1:], 3), np.uint8),
        np.zeros((count, 2), np.int32),
        np.zeros((count, 3, 3), np.float32),
        np.zeros((count, 4, 4), np.float32),
        np.ones(count, bool),
        depth=depth,
        depth_valid=depth > 0,
    )
    low, high, step = bounds
    return depth_targets(views, shape, low=low, high=high, step=step)


GRID = BevGrid(PerceptionRange((-8.0, 8.0), (-4.0, 4.0), (-3.0, 3.0)), 4, 8)
RASTER = TrafficRasterConfig(hidden=8)
CONFIG = LiftConfig(GRID, fine=1, dim=8, cameras=2, depth=(1.0, 9.0, 1.0), pyramid=4, dropout=0.0, image_scale=1.0)


def make_views(seed=0):
    """Return two cameras, ahead and back, with random images of different contents."""
    ahead = np.array([[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1]], np.float32)
    back = ahead @ np.diag([-1, -1, 1, 1]).astype(np.float32)
    intrinsics = np.tile(np.array([[20, 0, 24], [0, 20, 16], [0, 0, 1]], np.float32), (2, 1, 1))
    image = np.random.default_rng(seed).integers(0, 256, (2, 32, 48, 3), dtype=np.uint8)
    return CameraViews(image, np.tile([48, 32], (2, 1)), intrinsics, np.stack([ahead, back]), np.ones(2, bool))


@pytest.mark.parametrize("depth", [(1.0, 35.0, 0.75), (1.0, 1.5, 1.0)])
def test_depth_bins_are_whole(depth):
    """45 1/3 bins would give targets of a bin that the network does not have."""
    with pytest.raises(UserError, match=r"depth is .*whole bins from first to last"):
        check_settings(LiftConfig(depth=depth), "")
    check_settings(LiftConfig(depth=(1.0, 35.0, 0.1)), "")


@pytest.mark.slow
def test_kernels_start_as_published():
    """Xavier-uniform in the whole depth network; PyTorch's default in the heads of the masks."""
    cells, vector = jnp.zeros((1, 2, 3, 32)), jnp.zeros((1, 22))
    network, head = DepthNet(32, 12, 24), LineMaskHead()
    start = lambda: (network.init(jax.random.key(0), cells, vector, train=False), head.init(jax.random.key(1), cells))  # noqa: E731
    depth, mask = (flatten_dict(one["params"], sep="/") for one in jax.jit(start)())
    kernels = {name: leaf for name, leaf in depth.items() if name.endswith("kernel")}
    assert len(kernels) == 2 + 2 * (2 + 2) + 6 + 6 + 1
    for name, leaf in kernels.items():
        area = np.prod(leaf.shape[:-2], dtype=int)
        bound = np.sqrt(6.0 / (area * sum(leaf.shape[-2:])))
        assert 0.95 * bound < np.abs(leaf).max() <= bound, name
    for name, inputs in (("hidden/kernel", 9 * 32), ("out/kernel", 32)):
        assert 0.8 * inputs**-0.5 < np.abs(mask[name]).max() <= inputs**-0.5
    assert 0.0 < np.abs(mask["out/bias"]).max() <= 32**-0.5


def test_the_points_of_a_ray_are_seen_in_their_image_cell_at_their_depth():
    views = make_views()
    points = np.asarray(ray_points(views.intrinsics, views.camera_from_ego, (32, 48), (5, 7), (1.0, 9.0, 1.0)))
    assert points.shape == (2, 8, 5, 7, 3)
    for v in (0, 1):
        local = points[v] @ views.camera_from_ego[v, :3, :3].T + views.camera_from_ego[v, :3, 3]
        np.testing.assert_allclose(
            local[..., 2], np.broadcast_to(np.arange(1, 9.0)[:, None, None], (8, 5, 7)), atol=1e-4
        )
        pixel = (local @ views.intrinsics[v].T)[..., :2] / local[..., 2:]
        np.testing.assert_allclose(pixel[3, :, :, 0], np.tile(np.linspace(0, 47, 7), (5, 1)), atol=1e-3)
        np.testing.assert_allclose(pixel[3, :, :, 1], np.tile(np.linspace(0, 31, 5)[:, None], (1, 7)), atol=1e-3)


def test_collecting_is_the_sum_over_all_points_with_its_gradient():
    rng = np.random.default_rng(0)
    context, depth = (jnp.asarray(rng.normal(size=(2, 3, 4, n)), jnp.float32) for n in (5, 6))
    cells = rng.integers(0, 9, (2, 6, 3, 4))  # 7 cells, the others are outside
    stored = jnp.einsum("vhwc,vhwd->vdhwc", context, depth).reshape(-1, 5)
    table = jnp.asarray((cells.reshape(-1)[None] == np.arange(7)[:, None]).astype(np.float32))
    np.testing.assert_allclose(collect(context, depth, jnp.asarray(cells), 7), table @ stored, rtol=1e-4, atol=1e-5)
    weight = jnp.asarray(rng.normal(size=(7, 5)), jnp.float32)
    by_scan = jax.grad(lambda c, d: (collect(c, d, jnp.asarray(cells), 7) * weight).sum(), (0, 1))(context, depth)
    plain = lambda c, d: ((table @ jnp.einsum("vhwc,vhwd->vdhwc", c, d).reshape(-1, 5)) * weight).sum()  # noqa: E731
    for ours, theirs in zip(by_scan, jax.grad(plain, (0, 1))(context, depth), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


def test_points_outside_the_range_belong_to_no_cell_but_for_the_published_border():
    points = jnp.array([[-7.9, -3.9, 0.0], [-8.1, -3.9, 0.0], [-10.1, 0.0, 0.0], [7.9, 3.9, 0.0], [0.0, 0.0, 3.1]])
    points = jnp.concatenate([points, jnp.full((1, 3), jnp.nan)])
    assert cell_numbers(points, GRID, "exact").tolist() == [0, 32, 32, 31, 32, 32]
    assert cell_numbers(points, GRID, "published").tolist() == [0, 0, 32, 31, 32, 32]


def test_the_lower_borders_of_the_range_belong_to_its_cells_and_the_upper_ones_do_not():
    """A point on the upper border would count in the next row."""
    points = jnp.array([[-8.0, -4.0, -3.0], [8.0, -4.0, 0.0], [-8.0, 4.0, 0.0], [0.0, 0.0, 3.0], [-8.0, 0.0, 0.0]])
    assert cell_numbers(points, GRID, "exact").tolist() == [0, 32, 32, 32, 16]


class Shown(LiftEncoder):
    """The lift, which shows what its depth network learns of the cameras."""

    def encode(self, features, cameras, points, valid=None, *, train, fuse=None):
        return cameras


@pytest.mark.slow
def test_the_depth_network_knows_cameras_by_their_native_images_and_the_vehicles_own_frame():
    """Images are half the size of the native ones; the rear axle lies 1.4 m ahead of the example's frame, turned."""
    raised = np.asarray(yaw_pose(np.float32(-1.4), np.float32(0.2), np.float32(0.1)), np.float32)
    views = make_views()
    views = views.replace(vehicle=VehicleState(np.eye(4, dtype=np.float32), raised))
    model = Shown(replace(CONFIG, image_scale=0.5))
    vector = model.apply({}, jnp.ones((2, 4, 6, 8)), views, train=False, method="lift")
    for camera in (0, 1):
        np.testing.assert_allclose(vector[camera, :4], [40.0, 40.0, 48.0, 32.0], rtol=1e-5)
        np.testing.assert_allclose(vector[camera, 4:10], [0.5, 0.0, 0.0, 0.0, 0.5, 0.0], rtol=1e-5)
        pose = raised @ np.linalg.inv(views.camera_from_ego[camera])
        np.testing.assert_allclose(vector[camera, 10:], pose[:3].ravel(), atol=1e-5)


def test_cameras_may_change_places_and_a_missing_one_may_hold_anything():
    views, features = make_views(), jax.random.normal(jax.random.key(0), (2, 4, 6, 8))
    model = LiftEncoder(CONFIG)
    fresh = jax.eval_shape(lambda key: model.init(key, [features], views, train=False), jax.random.key(0))
    params = random_params(lambda key: model.init(key, [features], views, train=False)["params"])
    rest = {name: jax.tree.map(lambda leaf: jnp.ones(leaf.shape), x) for name, x in fresh.items() if name != "params"}
    run = jax.jit(lambda features, views: model.apply({"params": params} | rest, [features], views, train=False))
    bev = run(features, views)
    assert bev.shape == (4, 8, 8)
    swapped = run(features[::-1], jax.tree.map(lambda leaf: leaf[::-1], views))
    np.testing.assert_allclose(swapped, bev, rtol=1e-4, atol=1e-4)
    gone = views.replace(valid=np.array([True, False]))
    dirty = gone.replace(
        camera_from_ego=np.where(gone.valid[:, None, None], views.camera_from_ego, np.nan),
        intrinsics=np.where(gone.valid[:, None, None], views.intrinsics, np.nan),
    )
    one = run(features, gone)
    np.testing.assert_array_equal(run(features.at[1].set(jnp.nan), dirty), one)
    assert np.abs(one - bev).max() > 1e-3


@pytest.mark.slow
def test_an_absent_camera_is_none_at_all_in_training():
    """Norms of the batch: BEV features of one camera beside one that delivers nothing are those of the one."""
    views, features = make_views(), jax.random.normal(jax.random.key(0), (2, 4, 6, 8))
    views, model = views.replace(valid=np.array([True, False])), LiftEncoder(CONFIG)
    variables = jax.jit(lambda: model.init(jax.random.key(0), [features], views, train=False))()

    def run(features, views):
        return model.apply(variables, [features], views, train=True, mutable=["batch_stats"])

    one = jax.tree.map(lambda leaf: leaf[:1], views)
    (bev, statistics), (alone, expected) = jax.jit(lambda: (run(features, views), run(features[:1], one)))()
    np.testing.assert_allclose(bev, alone, rtol=1e-4, atol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), statistics, expected)


def test_a_prior_without_data_changes_no_bit_of_the_features():
    views, features = make_views(), jax.random.normal(jax.random.key(0), (2, 4, 6, 8))
    model, noise = LiftEncoder(CONFIG), jax.random.normal(jax.random.key(1), (32, CHANNELS))

    def fuse_of(touched):
        raster = TrafficRaster(noise, touched)
        return lambda layer, shape, bev, position: RasterFusion(RASTER.hidden, name="prior")(
            bev, raster.features, raster.touched
        )

    start = lambda key: model.init(key, [features], views, train=False, fuse=fuse_of(jnp.ones(32, bool)))  # noqa: E731
    fresh = jax.eval_shape(start, jax.random.key(0))
    variables = {name: jax.tree.map(lambda leaf: jnp.ones(leaf.shape), x) for name, x in fresh.items()}
    variables["params"] = random_params(lambda key: start(key)["params"])
    run = lambda features, fuse: model.apply(variables, [features], views, train=False, fuse=fuse)  # noqa: E731
    plain = jax.jit(lambda features: run(features, None))(features)
    hooked = jax.jit(lambda features, touched: run(features, fuse_of(touched)))
    np.testing.assert_array_equal(hooked(features, jnp.zeros(32, bool)), plain)
    some = jnp.arange(32) % 3 == 0
    changed = (np.asarray(hooked(features, some)) != np.asarray(plain)).any(-1)
    np.testing.assert_array_equal(changed.ravel(), some)
