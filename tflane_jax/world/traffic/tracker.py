"""Simulated 3-D detector and tracker of the ego vehicle: true actors in, noisy tracks out.

The detection probability falls with distance and with occlusion. Box noise grows with distance. A track that loses its
actor coasts at constant velocity (`occluded`) and then ends; the actor returns under a new identity. Close neighbours
sometimes swap identities.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.geometry import invert_pose, pose_yaw, transform_points
from tflane_jax.limits import CountOrZero, Fraction, Positive, PositiveOrZero
from tflane_jax.scene.logs import Tracks
from tflane_jax.world.bev.line_of_sight import hidden_points

# Points of a box tested for line of sight, in half lengths and half widths: middle and near the corners.
_PROBES = 0.9 * np.array([[0.0, 0.0], [1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
# Of a tracked size, as a fraction of the true one.
_LEAST_SIZE = 0.1


@dataclass(frozen=True)
class TrackerConfig:
    """Quality of the tracker.

    Attributes:
        range: distance up to which a fully visible actor is always detected, metres.
        falloff: distance beyond `range` over which the probability falls to 0, metres.
        view_needed: visible fraction of a box from which detection is certain; 0 ignores occlusion.
        drop: probability of missing an actor in a frame.
        position_noise: standard deviation of positions per axis at distance 0, metres.
        position_noise_growth: growth of `position_noise` with distance, metres per metre.
        yaw_noise: standard deviation of yaw, radians.
        size_noise: relative standard deviation of sizes, constant for a track.
        velocity_noise: standard deviation per axis of a coasting track's velocity, m/s.
        correlation: correlation of the noise from frame to frame, 0 to 1.
        coast: frames for which a lost track is continued.
        switch_rate: identity switches per second between two neighbours nearer than `switch_distance`.
        switch_distance: largest distance of neighbours that may switch identities, metres.
        look_every_s: interval at which line of sight is computed, seconds; it is interpolated in between.
    """

    range: Positive = 60.0
    falloff: Positive = 25.0
    view_needed: Fraction = 0.35
    drop: Fraction = 0.03
    position_noise: PositiveOrZero = 0.08
    position_noise_growth: PositiveOrZero = 0.003
    yaw_noise: PositiveOrZero = 0.03
    size_noise: PositiveOrZero = 0.03
    velocity_noise: PositiveOrZero = 0.3
    correlation: Fraction = 0.7
    coast: CountOrZero = 5
    switch_rate: Fraction = 0.02
    switch_distance: PositiveOrZero = 3.5
    look_every_s: Positive = 0.3

    def with_noise(self, scale: float) -> TrackerConfig:
        """Return the tracker with noise (that of sizes excepted) and misses scaled."""
        return replace(
            self,
            drop=min(self.drop * scale, 1.0),
            position_noise=self.position_noise * scale,
            position_noise_growth=self.position_noise_growth * scale,
            yaw_noise=self.yaw_noise * scale,
            velocity_noise=self.velocity_noise * scale,
            switch_rate=self.switch_rate * scale,
        )


def track(
    rng: np.random.Generator,
    actors: Tracks,
    global_from_ego: Float[np.ndarray, "f 4 4"],
    buildings: Float[np.ndarray, "b 5"],
    config: TrackerConfig,
    *,
    rate_hz: float,
) -> Tracks:
    """Return the tracks of the actors, one row for each identity in order of first appearance.

    Args:
        rng: stream.
        actors: the truth, each frame in its own ego frame.
        global_from_ego: ego poses.
        buildings: x, y, length, width, yaw in global coordinates.
        config: quality.
        rate_hz: frames per second.
    """
    frames, count = actors.valid.shape
    distance = np.linalg.norm(actors.position[..., :2], axis=-1)
    detected = _detections(rng, actors, global_from_ego, buildings, distance, config, rate_hz)
    noise = _noise(rng, (frames, count, 3), config.correlation)
    scale = config.position_noise + config.position_noise_growth * distance
    seen = actors.position.copy()
    seen[..., :2] += noise[..., :2] * scale[..., None]
    yaw = actors.yaw + noise[..., 2] * config.yaw_noise

    last = np.maximum.accumulate(np.where(detected, np.arange(frames)[:, None], -1), 0)
    lost = np.arange(frames)[:, None] - last
    coasting = (last >= 0) & (lost > 0) & (lost <= config.coast)
    velocity = _velocity(actors, global_from_ego)
    velocity += rng.normal(size=velocity.shape) * config.velocity_noise / rate_hz
    frame, k = np.nonzero(coasting)
    origin = last[frame, k]
    position_coast, yaw_coast = _coast(seen, yaw, velocity, origin, frame, k, global_from_ego)
    seen[frame, k], yaw[frame, k] = position_coast, yaw_coast

    identity = _identities(detected | coasting)
    identity = _switch(rng, identity, actors, config, rate_hz)
    size_noise = np.maximum(1.0 + rng.normal(size=(identity.max(initial=-1) + 1, 3)) * config.size_noise, _LEAST_SIZE)
    return _table(identity, seen, yaw, coasting, actors, size_noise)


def visible_share(
    actors: Tracks, global_from_ego: Float[np.ndarray, "f 4 4"], buildings: Float[np.ndarray, "b 5"], stride: int
) -> Float[np.ndarray, "f k"]:
    """Return the visible fraction of each box's probe points, computed every `stride` frames; 0 where not valid."""
    frames, count = actors.valid.shape
    looks = np.unique(np.append(np.arange(0, frames, stride), frames - 1)) if frames else np.zeros(0, int)
    fraction = np.zeros((len(looks), count))
    to_ego = invert_pose(global_from_ego)
    heading = pose_yaw(global_from_ego)
    for row, f in enumerate(looks):
        k = np.flatnonzero(actors.valid[f])
        if not len(k):
            continue
        size, yaw, at = actors.size[k], actors.yaw[f, k], actors.position[f, k]
        base = at[:, 2] - 0.5 * size[:, 2]
        boxes = np.concatenate([at[:, :2], size[:, :2], yaw[:, None], size[:, 2:], base[:, None]], -1)
        blocks = buildings.copy()
        blocks[:, :2] = buildings[:, :2] @ to_ego[f, :2, :2].T + to_ego[f, :2, 3]
        blocks[:, 4] -= heading[f]
        blocks = blocks[np.hypot(blocks[:, 0], blocks[:, 1]) - np.hypot(blocks[:, 2], blocks[:, 3]) / 2 < 90.0]
        cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        dx, dy = (0.5 * size[:, None, :2] * _PROBES).transpose(2, 0, 1)
        points = np.stack([at[:, :1] + cos * dx - sin * dy, at[:, 1:2] + sin * dx + cos * dy], -1)
        hidden = hidden_points(
            points.reshape(-1, 2),
            boxes,
            blocks,
            target_height=np.repeat(base + 0.6 * size[:, 2], len(_PROBES)),
            exclude=np.repeat(np.arange(len(k)), len(_PROBES)),
        )
        fraction[row, k] = 1.0 - hidden.reshape(len(k), -1).mean(1)
    if len(looks) == frames:
        return fraction
    nearest = np.searchsorted(looks, np.arange(frames), side="right") - 1
    following = np.minimum(nearest + 1, len(looks) - 1)
    weight = (np.arange(frames) - looks[nearest]) / np.maximum(looks[following] - looks[nearest], 1)
    # An actor that is absent at one of the two frames has no value there to interpolate with.
    before = np.where(actors.valid[looks[nearest]], fraction[nearest], fraction[following])
    after = np.where(actors.valid[looks[following]], fraction[following], fraction[nearest])
    return np.where(actors.valid, before + weight[:, None] * (after - before), 0.0)


def _detections(
    rng: np.random.Generator,
    actors: Tracks,
    global_from_ego: np.ndarray,
    buildings: np.ndarray,
    distance: Float[np.ndarray, "f k"],
    config: TrackerConfig,
    rate_hz: float,
) -> Bool[np.ndarray, "f k"]:
    """Draw in which frames each actor is detected."""
    if config.falloff > 0.0:
        chance = np.clip(1.0 - (distance - config.range) / config.falloff, 0.0, 1.0)
    else:
        chance = np.where(distance <= config.range, 1.0, 0.0)
    if config.view_needed > 0.0:
        stride = max(1, int(config.look_every_s * rate_hz + 1e-9))
        fraction = visible_share(actors, global_from_ego, buildings, stride)
        chance = chance * np.clip(fraction / config.view_needed, 0.0, 1.0)
    return actors.valid & (rng.random(distance.shape) < chance * (1.0 - config.drop))


def _noise(rng: np.random.Generator, shape: tuple[int, ...], correlation: float) -> np.ndarray:
    """Return unit-variance noise, first-order autoregressive along the first axis."""
    from scipy.signal import lfilter  # half a second, which a training on cached examples does not need

    white = rng.normal(size=shape)
    if not shape[0]:
        return white
    white[1:] *= np.sqrt(1.0 - correlation**2)
    return np.asarray(lfilter([1.0], [1.0, -correlation], white, axis=0))


def _velocity(actors: Tracks, global_from_ego: Float[np.ndarray, "f 4 4"]) -> Float[np.ndarray, "f k 2"]:
    """Return each actor's true motion since the frame before, metres per frame along the global axes.

    It is 0 in the first frame of an actor, because one detection gives no velocity.
    """
    xy = transform_points(global_from_ego, actors.position)[..., :2]
    step = np.zeros_like(xy)
    known = actors.valid[1:] & actors.valid[:-1]
    step[1:] = np.where(known[..., None], xy[1:] - xy[:-1], 0.0)
    return step


def _coast(
    seen: Float[np.ndarray, "f k 3"],
    yaw: Float[np.ndarray, "f k"],
    velocity: Float[np.ndarray, "f k 2"],
    origin: Int[np.ndarray, " m"],
    frame: Int[np.ndarray, " m"],
    k: Int[np.ndarray, " m"],
    global_from_ego: Float[np.ndarray, "f 4 4"],
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, " m"]]:
    """Return boxes at M (frame, actor) pairs, extrapolated from the frame `origin` at constant velocity and heading."""
    start = transform_points(global_from_ego[origin], seen[origin, k][:, None])[:, 0]
    start[:, :2] += velocity[origin, k] * (frame - origin)[:, None]
    position = transform_points(invert_pose(global_from_ego[frame]), start[:, None])[:, 0]
    heading = pose_yaw(global_from_ego)
    return position, yaw[origin, k] + heading[origin] - heading[frame]


def _identities(reported: Bool[np.ndarray, "f k"]) -> Int[np.ndarray, "f k"]:
    """Number the unbroken stretches of reports by first frame, then actor; -1 where nothing is reported."""
    begins = reported.copy()
    begins[1:] &= ~reported[:-1]
    number = np.cumsum(begins.reshape(-1)).reshape(begins.shape) - 1
    started = np.maximum.accumulate(np.where(begins, number, -1), 0)
    return np.where(reported, started, -1)


def _switch(
    rng: np.random.Generator, identity: Int[np.ndarray, "f k"], actors: Tracks, config: TrackerConfig, rate_hz: float
) -> Int[np.ndarray, "f k"]:
    """Swap the identities of random close neighbours from a random frame on."""
    if config.switch_rate <= 0.0 or identity.shape[1] < 2:
        return identity
    identity = identity.copy()
    xy = actors.position[..., :2].astype(np.float32)
    there = (identity >= 0) & actors.valid
    there[1:] &= identity[:-1] >= 0
    there[:1] = False
    x, y = np.where(there[..., None], xy, np.inf).transpose(2, 0, 1)
    seen = np.flatnonzero(there.any(0))
    at, elsewhere = np.where(there, x, 0.0)[:, seen], np.where(there, x, 1e6)[:, seen]
    near_x = np.abs(at[:, :, None] - elsewhere[:, None]) < config.switch_distance
    frame, a, b = np.nonzero(np.triu(near_x, 1))
    a, b = seen[a], seen[b]
    close = there[frame, a] & there[frame, b]
    frame, a, b = frame[close], a[close], b[close]
    close = np.hypot(x[frame, a] - x[frame, b], y[frame, a] - y[frame, b]) < config.switch_distance
    frame, a, b = frame[close], a[close], b[close]
    happens = rng.random(len(frame)) < config.switch_rate / rate_hz
    for f, i, j in zip(frame[happens], a[happens], b[happens], strict=True):
        one, other = identity[f, i], identity[f, j]
        later = identity[f:]
        was_one, was_other = later == one, later == other
        later[was_one], later[was_other] = other, one
    return identity


def _table(
    identity: Int[np.ndarray, "f k"],
    position: Float[np.ndarray, "f k 3"],
    yaw: Float[np.ndarray, "f k"],
    coasting: Bool[np.ndarray, "f k"],
    actors: Tracks,
    size_noise: Float[np.ndarray, "i 3"],
) -> Tracks:
    """Return the reports with a row for each identity."""
    frames, count = len(identity), len(size_noise)
    frame, k = np.nonzero(identity >= 0)
    row = identity[frame, k]
    out_position, out_yaw = np.zeros((frames, count, 3)), np.zeros((frames, count))
    occluded, valid = np.zeros((frames, count), bool), np.zeros((frames, count), bool)
    out_position[frame, row], out_yaw[frame, row] = position[frame, k], wrap_outside(yaw[frame, k])
    occluded[frame, row], valid[frame, row] = coasting[frame, k], True
    # A track keeps size and category of the actor that it began with.
    row, first = np.unique(row, return_index=True)
    size = actors.size[k[first]] * size_noise[row]
    return Tracks(
        position=out_position,
        yaw=out_yaw,
        size=size,
        category=actors.category[k[first]],
        occluded=occluded,
        valid=valid,
        uuid=np.array([f"track-{i:03d}" for i in row], dtype="<U16"),
    )


def wrap_outside(angle: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Return angles in (-pi, pi]; unlike with `geometry.wrap_angle`, those already inside keep their bits."""
    inside = (angle > -np.pi) & (angle <= np.pi)
    return np.where(inside, angle, np.pi - (np.pi - angle) % (2.0 * np.pi))
