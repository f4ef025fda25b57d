"""The traffic-flow prior: thresholds, weights, selection, padding, numpy against jit."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tflane_jax.geometry import PerceptionRange
from tflane_jax.priors.traffic_flow import TrafficFlowPriorConfig, ego_centric_weight
from tflane_jax.priors.traffic_flow import select_traffic_flow as select_within
from tflane_jax.scene import TrafficFlow

CONFIG = TrafficFlowPriorConfig(max_instances=6)
REGION = PerceptionRange()
select_traffic_flow = functools.partial(select_within, region=REGION)


def make_flow(seed: int = 0, instances: int = 12, frames: int = 20, capacity: int = 16) -> TrafficFlow:
    rng = np.random.default_rng(seed)
    flow = TrafficFlow.empty(capacity, frames)
    start = rng.uniform([-60, -30, -1], [60, 30, 1], (capacity, 3))
    step = rng.uniform(-1, 1, (capacity, 3)) * [1, 1, 0.01]
    position = start[:, None] + step[:, None] * np.arange(frames)[None, :, None]
    exists = np.arange(capacity) < instances
    return flow.replace(
        position=position.astype(np.float32),
        yaw=rng.uniform(-3, 3, (capacity, frames)).astype(np.float32),
        size=rng.uniform(1, 10, (capacity, 3)).astype(np.float32),
        category=rng.integers(0, 6, capacity).astype(np.int32),
        occluded=rng.random((capacity, frames)) < 0.3,
        valid=(rng.random((capacity, frames)) < 0.8) & exists[:, None],
    )


def weight_at(x: float, y: float, config: TrafficFlowPriorConfig) -> float:
    """Return the weight of one place by its formula: x ahead, metres."""
    beyond = abs(math.degrees(math.atan2(y, x))) - config.front_sector_deg / 2
    if beyond <= 0:
        return 1.0
    turned = beyond / (180 - config.front_sector_deg / 2)
    return (1 - 0.5 * turned) / (1 + math.hypot(x, y) / config.distance_scale)


def loop_selection(flow: TrafficFlow, config: TrafficFlowPriorConfig) -> list[int]:
    """Return the selected instances by plain loops, after the paper's description."""
    ranked = []
    for k in range(len(flow.category)):
        frames = [
            n
            for n in range(flow.valid.shape[1])
            if flow.valid[k, n]
            and not flow.occluded[k, n]
            and abs(flow.position[k, n, 0]) <= 50
            and abs(flow.position[k, n, 1]) <= 25
        ]
        if len(frames) < config.min_valid_frames:
            continue
        x, y = flow.position[k, frames[-1], :2]
        ranked.append((-weight_at(x, y, config), float(np.hypot(x, y)), k))
    return [k for *_, k in sorted(ranked)][: config.max_instances]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("tolerance", [1, 5, 10])
def test_selection_matches_plain_loops(seed, tolerance):
    config = dataclasses.replace(CONFIG, min_valid_frames=tolerance)
    flow = make_flow(seed)
    tracks = select_traffic_flow(flow, config)
    expected = loop_selection(flow, config)
    assert tracks.index[tracks.valid].tolist() == expected
    assert tracks.valid.tolist() == [i < len(expected) for i in range(6)]


@pytest.mark.parametrize("seed", range(3))
def test_every_instance_keeps_its_own_size_category_heading_and_weight(seed):
    flow = make_flow(seed)
    tracks = select_traffic_flow(flow, CONFIG)
    assert tracks.valid.any()
    for slot in np.flatnonzero(tracks.valid):
        k, there = tracks.index[slot], tracks.frame_valid[slot]
        np.testing.assert_array_equal(tracks.size[slot], flow.size[k])
        assert tracks.category[slot] == flow.category[k]
        np.testing.assert_array_equal(tracks.position[slot][there], flow.position[k][there])
        yaw = flow.yaw[k][there]
        np.testing.assert_allclose(tracks.heading[slot][there], np.stack([np.cos(yaw), np.sin(yaw)], -1), atol=1e-6)
        np.testing.assert_array_equal(tracks.heading[slot][~there], 0.0)
        x, y = flow.position[k, np.flatnonzero(there)[-1], :2]
        assert tracks.weight[slot] == pytest.approx(weight_at(x, y, CONFIG), rel=1e-5)


def test_jit_gives_the_same():
    flow = make_flow(3)
    host = select_traffic_flow(flow, CONFIG)
    device = jax.jit(lambda f: select_traffic_flow(f, CONFIG))(jax.tree.map(jnp.asarray, flow))
    for field in dataclasses.fields(host):
        a, b = getattr(host, field.name), np.asarray(getattr(device, field.name))
        assert a.dtype.kind == b.dtype.kind, field.name
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=2e-6, err_msg=field.name)


def test_padding_may_hold_nan():
    flow = make_flow(4, instances=7)
    dirty = flow.replace(
        position=np.where(flow.valid[..., None], flow.position, np.nan),
        yaw=np.where(flow.valid, flow.yaw, np.nan),
        size=np.where(flow.valid.any(-1)[:, None], flow.size, np.nan),
    )
    jax.tree.map(np.testing.assert_array_equal, select_traffic_flow(flow, CONFIG), select_traffic_flow(dirty, CONFIG))


def test_positions_are_metres_whatever_the_encoder_reads():
    """The setting is that of the temporal encoder."""
    found = [
        select_traffic_flow(make_flow(5), dataclasses.replace(CONFIG, coordinates=coordinates))
        for coordinates in ("normalised", "metres")
    ]
    jax.tree.map(np.testing.assert_array_equal, *found)


@pytest.mark.parametrize(("instances", "capacity", "frames"), [(0, 4, 20), (1, 1, 20), (3, 4, 22), (0, 0, 20)])
def test_sizes(instances, capacity, frames):
    flow = make_flow(6, instances, frames, capacity)
    tracks = select_traffic_flow(flow, dataclasses.replace(CONFIG, min_valid_frames=1))
    assert tracks.frame_valid.shape == (6, 20)
    assert tracks.valid.sum() <= instances
    assert not tracks.frame_valid[~tracks.valid].any()
    assert not tracks.position[~tracks.valid].any()


def test_no_top_instances_is_no_traffic():
    tracks = select_traffic_flow(make_flow(7), dataclasses.replace(CONFIG, top_instances=0))
    assert not tracks.valid.any()
    assert not tracks.frame_valid.any()
    assert not tracks.size.any()


def test_too_few_frames_is_an_error():
    with pytest.raises(ValueError, match="holds 4 frames, the prior asks for 20"):
        select_traffic_flow(make_flow(frames=4), CONFIG)


def test_a_batch_is_named_as_such():
    """Its second axis would be taken for the frames."""
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], make_flow(7))
    with pytest.raises(ValueError, match=r"position has shape \(1, 16, 20, 3\), expected \(K, N, 3\): one frame"):
        select_traffic_flow(batch, CONFIG)


@settings(max_examples=60)
@given(st.floats(0.5, 70), st.floats(-np.pi, np.pi), st.floats(0.1, 30))
def test_weights(distance, bearing, farther):
    def weight(d, b):
        return float(ego_centric_weight(np.array([[d * np.cos(b), d * np.sin(b)]]), CONFIG)[0])

    here = weight(distance, bearing)
    assert 0 < here <= 1
    assert here == pytest.approx(weight(distance, -bearing))
    if abs(bearing) < np.pi / 6 - 1e-6:
        assert here == 1
    elif abs(bearing) > np.pi / 6 + 1e-6:
        assert here < 1
        assert weight(distance + farther, bearing) < here


@pytest.mark.parametrize(
    ("x", "y", "scale", "expected"),
    [
        (9.0, 5.0, 10.0, 1.0),  # 29 degrees
        (0.0, 10.0, 10.0, 0.8 / 2),  # 60 of the 150 degrees outside the sector: 1 - 0.5 * 0.4
        (0.0, -30.0, 10.0, 0.8 / 4),
        (-1e-9, 0.0, 10.0, 0.5),
        (-25.0, 0.0, 25.0, 0.5 / 2),
    ],
)
def test_weights_by_hand(x, y, scale, expected):
    """Half as much behind as ahead, and halved at `distance_scale`; `forward` names the axis that points ahead."""
    config = TrafficFlowPriorConfig(distance_scale=scale)
    np.testing.assert_allclose(ego_centric_weight(np.array([[x, y]]), config), expected, rtol=1e-6)
    np.testing.assert_allclose(ego_centric_weight(np.array([[-y, x]]), config, "y"), expected, rtol=1e-6)


@settings(max_examples=20)
@given(st.integers(0, 100), st.randoms(use_true_random=False))
def test_order_of_instances_does_not_matter(seed, random):
    flow = make_flow(seed)
    order = list(range(len(flow.category)))
    random.shuffle(order)
    shuffled = jax.tree.map(lambda x: x[np.array(order)], flow)
    a, b = select_traffic_flow(flow, CONFIG), select_traffic_flow(shuffled, CONFIG)
    np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(a.frame_valid, b.frame_valid)
    np.testing.assert_array_equal(a.category, b.category)


def test_a_sector_all_around_gives_every_instance_the_same_weight():
    places = np.array([[-9.0, 0.0], [-3.0, -1e-6], [4.0, 5.0], [0.0, 0.0]], np.float32)
    np.testing.assert_array_equal(ego_centric_weight(places, TrafficFlowPriorConfig(front_sector_deg=360.0)), 1.0)


@pytest.mark.parametrize("frames", [1, 5, 20])
def test_only_the_last_frames_count(frames):
    """The selection is that of a recording which begins with them; what was hidden before does not matter."""
    flow, config = make_flow(3), dataclasses.replace(CONFIG, frames=frames, min_valid_frames=1)
    by_frame = {name: getattr(flow, name)[:, -frames:] for name in ("position", "yaw", "occluded", "valid")}
    found, expected = select_traffic_flow(flow, config), select_traffic_flow(flow.replace(**by_frame), config)
    assert found.frame_valid.any()
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_in_the_front_sector_the_nearest_come_first():
    """By distance, not by how far ahead they are."""
    flow = make_flow(instances=3, capacity=3)
    flow.position[:] = np.array([(18.0, 10.0, 0.0), (20.0, 0.0, 0.0), (17.0, -8.0, 0.0)])[:, None]
    flow.valid[:], flow.occluded[:] = True, False
    tokens = select_traffic_flow(flow, CONFIG)
    assert tokens.weight[:3].tolist() == [1.0] * 3
    assert tokens.index[:3].tolist() == [2, 1, 0]
