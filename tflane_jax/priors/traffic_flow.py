"""The traffic-flow prior of TF-Lane (sections 3.2 and 3.3, "Temporal Domain Encoder"), up to the learned part.

Steps: truncate the tracks to the region R_t, drop instances with fewer than tol_pts valid frames, weight the others by
their position relative to the ego vehicle, keep the T_top with the largest weights, pad to T_max. Runs in numpy or
under jit, depending on the arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from flax import struct
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import PerceptionRange
from tflane_jax.geometry.namespace import namespace
from tflane_jax.limits import Count, CountOrZero, Positive, Rules, within
from tflane_jax.scene import TrafficFlow
from tflane_jax.scene.arrays import Array


@dataclass(frozen=True)
class TrafficFlowPriorConfig:
    """Selection and encoding of traffic flow.

    Attributes:
        frames: f_t, number of past frames, the latest ones (paper: 20).
        min_valid_frames: tol_pts, an instance needs this many valid frames (paper: 5).
        max_instances: T_max, the number of slots (paper: N_t = 30).
        top_instances: T_top, largest number of filled slots; None: all slots. 0 is inference without traffic flow.
        occluded_frames: "mask" ignores frames in which the tracker did not see the box (Fig. 4); "keep" uses them.
        front_sector_deg: opening angle of the front sector, which has the highest weight (paper: 60).
        distance_scale: distance that halves the weight of an instance outside that sector, metres.
        coordinates: of positions as the temporal encoder reads them: "normalised" aligns them with the BEV in [0, 1]
            (Table 5, "Norm." = T); "metres" does not.
    """

    frames: Count = 20
    min_valid_frames: Count = 5
    max_instances: Count = 30
    top_instances: CountOrZero | None = None
    occluded_frames: Literal["mask", "keep"] = "mask"
    front_sector_deg: Annotated[float, within(0, 360)] = 60.0
    distance_scale: Positive = 25.0
    coordinates: Literal["normalised", "metres"] = "normalised"

    def limits(self) -> Rules:
        """An instance can have enough frames, and a slot."""
        yield "min_valid_frames", self.min_valid_frames <= self.frames, f"at most frames ({self.frames})"
        fits = self.top_instances is None or self.top_instances <= self.max_instances
        yield "top_instances", fits, f"at most max_instances ({self.max_instances})"


@struct.dataclass
class SelectedTracks:
    """reTF_i and its temporal mask: T_max instances of N frames, by descending weight.

    Attributes:
        position: (T, N, 3) box centers, metres, frame of the host; 0 where not valid.
        heading: (T, N, 2) cos and sin of the yaw in the ego frame; 0 where not valid.
        size: (T, 3) length, width, height, metres; 0 in padding.
        category: (T,) `scene.RoadUser`; 0 in padding.
        frame_valid: (T, N) the temporal mask.
        valid: (T,) instance validity, the source of the spatial mask.
        weight: (T,) ego-centric weight in (0, 1]; 0 in padding.
        index: (T,) index of the instance in the traffic flow; 0 in padding.
    """

    position: Float[Array, "t n 3"]
    heading: Float[Array, "t n 2"]
    size: Float[Array, "t 3"]
    category: Int[Array, " t"]
    frame_valid: Bool[Array, "t n"]
    valid: Bool[Array, " t"]
    weight: Float[Array, " t"]
    index: Int[Array, " t"]


def select_traffic_flow(
    flow: TrafficFlow,
    config: TrafficFlowPriorConfig,
    region: PerceptionRange,
    forward: Literal["x", "y"] = "x",
) -> SelectedTracks:
    """Return the selected tracks of one frame's traffic flow; padding in `flow` may hold anything.

    Args:
        flow: tracks in the current frame of the host.
        config: selection.
        region: R_t, the host's perception range; positions outside it are ignored.
        forward: axis of the host's frame that points ahead: y in the axes of nuScenes' lidar.

    Raises:
        ValueError: the traffic flow has fewer frames than the configuration, or is that of a batch.
    """
    if flow.position.ndim != 3:
        shape = tuple(flow.position.shape)
        raise ValueError(f"position has shape {shape}, expected (K, N, 3): one frame; jax.vmap adds batches")
    xp = namespace(flow.position, flow.valid)
    recorded = flow.valid.shape[1]
    if recorded < config.frames:
        raise ValueError(
            f"the traffic flow holds {recorded} frames, the prior asks for {config.frames}: raise "
            "ExampleConfig.history or lower TrafficFlowPriorConfig.frames"
        )
    if flow.valid.shape[0] == 0:
        flow = TrafficFlow.empty(1, recorded)  # the padding below needs a row to index
    flow = TrafficFlow(
        position=flow.position[:, recorded - config.frames :],
        yaw=flow.yaw[:, recorded - config.frames :],
        size=flow.size,
        category=flow.category,
        occluded=flow.occluded[:, recorded - config.frames :],
        valid=flow.valid[:, recorded - config.frames :],
    )
    observed = flow.valid if config.occluded_frames == "keep" else flow.valid & ~flow.occluded
    position = xp.where(flow.valid[..., None], flow.position, 0.0)
    frame_valid = observed & region.contains(position)
    instance_valid = frame_valid.sum(-1) >= max(config.min_valid_frames, 1)

    latest = _latest_valid(frame_valid)
    here = xp.take_along_axis(position[..., :2], latest[:, None, None], axis=1)[:, 0]
    weight = xp.where(instance_valid, ego_centric_weight(here, config, forward), 0.0)

    # By descending weight, then by distance (the whole front sector has one weight); both sorts are stable.
    nearest = xp.argsort(xp.where(instance_valid, (here**2).sum(-1), xp.inf), stable=True)
    order = nearest[xp.argsort(-weight[nearest], stable=True)]
    slots = config.max_instances
    order = xp.concatenate([order, xp.zeros(max(slots - len(order), 0), order.dtype)])[:slots]
    allowed = slots if config.top_instances is None else config.top_instances
    filled = xp.arange(slots) < xp.minimum(instance_valid.sum(), allowed)

    frame_valid = frame_valid[order] & filled[:, None]
    yaw = xp.where(frame_valid, flow.yaw[order], 0.0)
    return SelectedTracks(
        position=xp.where(frame_valid[..., None], position[order], 0.0),
        heading=xp.where(frame_valid[..., None], xp.stack([xp.cos(yaw), xp.sin(yaw)], -1), 0.0),
        size=xp.where(filled[:, None], flow.size[order], 0.0),
        category=xp.where(filled, flow.category[order], 0),
        frame_valid=frame_valid,
        valid=filled,
        weight=xp.where(filled, weight[order], 0.0),
        index=xp.where(filled, order, 0),
    )


def ego_centric_weight(
    position: Float[Array, "k 2"], config: TrafficFlowPriorConfig, forward: Literal["x", "y"] = "x"
) -> Float[Array, " k"]:
    """Return the weight of instances at these positions (metres, vehicle at the origin), in (0, 1].

    1 within the front sector; elsewhere it decreases with bearing and distance. The paper (section 3.3) defines the
    sector and states that weights decrease "based on relative positions"; both factors are our choice.
    """
    xp = namespace(position)
    half = math.radians(config.front_sector_deg) / 2
    ahead, aside = (0, 1) if forward == "x" else (1, 0)
    bearing = xp.abs(xp.arctan2(position[..., aside], position[..., ahead]))
    distance = xp.sqrt((position**2).sum(-1))
    # A sector of 360 degrees has nothing outside.
    off_axis = 1.0 - 0.5 * (bearing - half) / ((math.pi - half) or 1.0)
    outside = off_axis / (1.0 + distance / config.distance_scale)
    return xp.where(bearing <= half, xp.ones_like(outside), outside)


def _latest_valid(frame_valid: Bool[Array, "k n"]) -> Int[Array, " k"]:
    """Return the index of the last valid frame of each instance (the last frame if there is none)."""
    xp = namespace(frame_valid)
    return frame_valid.shape[1] - 1 - xp.argmax(xp.flip(frame_valid, axis=1), axis=1)
