"""The fixtures of BEV encoders and constructers as arguments of our modules."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.golden import implemented, numbered, options
from tflane_jax.geometry import BevGrid, PerceptionRange
from tflane_jax.geometry.poses import yaw_pose
from tflane_jax.models.bevformer import BevFormerConfig, BevMemory, align
from tflane_jax.scene import CameraViews


def is_baseline(case):
    """Return whether the case is of OpenLane-V2's baseline or SMERF, whose code departs from BEVFormer's elsewhere."""
    return any(name in case.source for name in ("SMERF", "OpenLane-V2"))


def is_toponet(case):
    return any(name in case.source for name in ("TopoNet", "LaneSegNet"))


def bev_config(case):
    """Return the reference's configuration, with the options that reproduce its departures from the paper.

    Sizes that `meta` does not tell are read from the shapes of the parameters.
    """
    found = options(
        case,
        *("dim", "heads", "bev", "pc_range", "cams"),
        layers=None,
        hidden=None,
        tsa_points=None,
        points=None,
        anchors=4,
        rotate_center=None,
    )
    implemented(case, can_bus_norm=[True])
    low, high = np.array(found.pc_range).reshape(2, 3)
    limits = PerceptionRange(*map(tuple, zip(low, high, strict=True)))
    prefix = r"(?:encoder\.)?layers\."
    layers = numbered(case.params, prefix + r"(\d+)\.norms\.0\.weight")
    below = layers[0].removesuffix("norms.0.weight")
    levels = len(case.inputs["spatial_shapes"]) if "spatial_shapes" in case.inputs else len(level_names(case))
    offsets = [
        len(case.params[f"{below}attentions.{part}sampling_offsets.bias"]) for part in ("0.", "1.deformable_attention.")
    ]
    hidden = len(case.params[f"{below}ffns.0.layers.0.0.bias"])
    return BevFormerConfig(
        BevGrid(limits, *found.bev),
        found.dim,
        found.heads,
        found.layers or len(layers),
        found.hidden or hidden,
        # Offsets are (x, y) of each point, head, and frame or level.
        temporal_points=found.tsa_points or offsets[0] // (2 * 2 * found.heads),
        spatial_points=found.points or offsets[1] // (2 * levels * found.heads),
        anchors=found.anchors,
        levels=levels,
        cameras=found.cams,
        align="reference" if is_toponet(case) else "bevformer",
        rotation_center=tuple(found.rotate_center or ()) or None,
        temporal_value="initial",
        value_projections=2 if is_baseline(case) else 1,
    )


def level_names(case):
    """Return the names of the image features, finest level first."""
    return numbered(case.inputs, r"feat(\d+)")


def golden_views(arrays):
    """Return the views of every batch element, stacked: the reference has one matrix from the vehicle to the pixels.

    Its image size is that of the first camera of the first element, for all.
    """
    matrix = arrays["lidar2img"]
    height, width = (int(n) for n in np.reshape(arrays["img_hw"], (-1, 2))[0])
    batch, cameras = matrix.shape[:2]
    eye = np.broadcast_to(np.eye(3, dtype=np.float32), (batch, cameras, 3, 3))
    return CameraViews(
        np.zeros((batch, cameras, height, width, 3), np.uint8),
        np.tile([width, height], (batch, cameras, 1)),
        eye,
        matrix,
        np.ones((batch, cameras), bool),
    )


def previous_features(case, config):
    """Return the previous BEV features of every batch element (B, h, w, C), NaN where there are none."""
    grid, batch = config.grid, len(case.inputs["can_bus"])
    shape = (batch, grid.rows, grid.columns, config.dim)
    if "prev_bev" not in case.inputs:
        return np.full(shape, np.nan, np.float32)
    past = case.inputs["prev_bev"]
    # The reference takes (B, HW, C), and (HW, B, C) as well.
    return (past if past.shape[1] == grid.rows * grid.columns else past.swapaxes(0, 1)).reshape(shape)


def pose_of_motion(case, config, index):
    """Return the pose of a batch element that the reference's vector of vehicle motion stands for.

    It is rotated by the last entry (degrees), and moved in global axes by the first. TopoNet brings those into the
    vehicle's axes by the rotation of the pose, BEVFormer by the heading (radians) in the entry before the last.
    """
    motion = case.inputs["can_bus"][index].astype(np.float64)
    flags = options(case, use_shift=True, rotate_prev_bev=True)
    if config.align == "reference":
        moved = case.inputs["lidar2global_rotation"][index].astype(np.float64).T @ motion[:3]
    else:
        moved = np.append(yaw_pose(0.0, 0.0, motion[-2])[:2, :2].T @ motion[:2], 0.0)
    pose = yaw_pose(0.0, 0.0, np.deg2rad(motion[-1]) if flags.rotate_prev_bev else 0.0)
    pose[:3, 3] = pose[:3, :3] @ moved if flags.use_shift else 0.0
    return pose.astype(np.float32)


def aligned(case, config):
    """Return the memory of every batch element in its present frame, and the shifts (B, 2)."""
    past = previous_features(case, config)
    poses = np.stack([pose_of_motion(case, config, i) for i in range(len(past))])
    memory = BevMemory(jnp.asarray(past), jnp.full(len(past), "prev_bev" in case.inputs))
    return jax.vmap(lambda memory, pose: align(config, memory, pose))(memory, jnp.asarray(poses))


def without_unused(case, params):
    """Return the parameters of `BevFormer` with those zeroed that the reference has switched off."""
    flags = options(case, use_can_bus=True, use_cams_embeds=True)
    if not flags.use_can_bus:
        params = params | {
            "motion": params["motion"] | {"norm": jax.tree.map(jnp.zeros_like, params["motion"]["norm"])}
        }
    return params if flags.use_cams_embeds else params | {"cameras": jnp.zeros_like(params["cameras"])}
