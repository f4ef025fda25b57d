"""The fixed worlds: their roads and how much traffic they have."""

from dataclasses import replace

import numpy as np
import pytest

from tests.shared import shared_path
from tflane_jax.datasets.procedural import ProceduralDataset, WorldData
from tflane_jax.evaluation.scene_statistics import frame_quantities, lane_quantities, pooled
from tflane_jax.world.presets import CITY, REAL_LIKE, STREET
from tflane_jax.world.roads.config import RoadConfig, SceneKind
from tflane_jax.world.roads.networks import build_road_network
from tflane_jax.world.simulate import WorldConfig, simulate

JUNCTIONS = {SceneKind.T_JUNCTION, SceneKind.FOUR_WAY, SceneKind.TWO_JUNCTIONS, SceneKind.ROUNDABOUT}

# World, frames of history, and what `sums` gave when experiments on it were published.
AS_PUBLISHED = [
    (WorldConfig(), 20, (34060, 2914363.51110603, 3218.4698181625568, 571, 81, 122783.36206247966, 1524)),
    (CITY, 100, (48618, 6014682.7110637305, 3300.551992889188, 575, 81, 952866.7843320188, 7504)),
    (STREET, 100, (39571, 4988604.099999456, 3289.007818738347, 471, 28, 58270.826282535454, 1111)),
]

BOXES = ((50.0, 25.0), (30.0, 15.0))


def networks(roads, count):
    return [build_road_network(np.random.default_rng([seed]), roads) for seed in range(count)]


def test_city_has_the_kinds_of_the_default_world():
    assert CITY.roads.kinds == RoadConfig().kinds


def sums(world, history):
    """Numbers of which a change of the world changes at least one: of twelve networks, and of one scene."""
    found = networks(world.roads, 12)
    lines = [
        line
        for net in found
        for line in (
            *(edge for s in net.map.segments.values() for edge in (s.left, s.right)),
            *net.map.road_boundaries,
            *net.map.crossings,
            *net.map.roads,
            net.map.buildings,
            net.parking,
        )
    ]
    log = simulate(5, world, history)
    return (
        sum(map(len, lines)),
        sum(float(np.abs(line).sum()) for line in lines),
        sum(sum(net.speed_limit.values()) for net in found),
        sum(len(s.successors) + int(s.left_type) for net in found for s in net.map.segments.values()),
        sum(len(others) for net in found for others in net.yield_to.values()),
        float(np.abs(log.actors.position).sum()),
        int(log.tracks.valid.sum()),
    )


@pytest.mark.parametrize(("world", "history", "expected"), AS_PUBLISHED)
def test_worlds_of_published_experiments_are_as_they_were(world, history, expected):
    """Settings that other worlds have must not change a draw of these. Sines may differ in their last bits."""
    assert sums(world, history) == pytest.approx(expected, rel=1e-7)


@pytest.mark.slow
def test_real_like_roads_are_all_but_junctions_with_many_connectors():
    found = networks(REAL_LIKE.roads, 40)
    kinds = [network.kind for network in found]
    assert {kind for kind, _ in REAL_LIKE.roads.kinds} >= set(kinds)
    assert {SceneKind.FIVE_LEGS, SceneKind.STAGGERED} <= set(kinds)
    assert np.mean([kind is SceneKind.ROAD for kind in kinds]) < 0.1
    connectors, usual = (
        np.mean([sum(s.is_intersection for s in network.map.segments.values()) for network in some])
        for some in (found, networks(CITY.roads, 40))
    )
    assert connectors > 1.7 * usual


# Means over 100 key frames of nine recorded logs (docs/real_roads.md).
RECORDED = {
    "lanes": 21.6,
    "connectors": 11.8,
    "metres of lane": 604,
    "topology links": 19.7,
    "lanes beside the vehicle": 2.67,
    "oncoming lanes beside the vehicle": 2.15,
    "length, m": 27.9,
    "width, m": 4.14,
    "painted sides": 0.57,
    "turn, degrees": 27.7,
    "visible fraction": 0.615,
}


@pytest.mark.slow
def test_frames_of_real_like_hold_as_much_as_recorded_ones():
    dataset = ProceduralDataset(WorldData.real_like(train=60).source("train"))
    examples = [dataset.example(i) for i in range(len(dataset))]
    found = pooled([frame_quantities(e) | lane_quantities(e) for e in examples])
    for quantity, recorded in RECORDED.items():
        assert np.mean(found[quantity]) == pytest.approx(recorded, rel=0.2), quantity


def test_street_has_no_junction_but_small_t_junctions():
    found = networks(STREET.roads, 60)
    kinds = {network.kind for network in found}
    assert kinds == {kind for kind, _ in STREET.roads.kinds}
    assert kinds & JUNCTIONS == {SceneKind.T_JUNCTION}
    for network in found:
        if network.kind is SceneKind.T_JUNCTION:
            connectors = [s for s in network.map.segments.values() if s.is_intersection and s.vehicle]
            # Three arms of one lane connect to two others each; a one-way side street has two lanes in one direction.
            assert 2 <= len(connectors) <= 8


def test_junction_lanes_limit_the_main_road():
    kinds = ((SceneKind.FOUR_WAY, 1.0),)
    wide, narrow = (networks(RoadConfig(kinds=kinds, junction_lanes=lanes), 12) for lanes in (3, 1))
    connectors = [
        [sum(s.is_intersection and s.vehicle for s in network.map.segments.values()) for network in found]
        for found in (wide, narrow)
    ]
    # Four arms of one lane each connect to three others.
    assert max(connectors[1]) <= 12 < max(connectors[0])
    assert all(few <= many for many, few in zip(*connectors, strict=True))


@pytest.mark.parametrize(("world", "box", "low", "high"), [(CITY, (50.0, 25.0), 17, 40), (STREET, (30.0, 15.0), 6, 20)])
def test_traffic_is_as_dense_as_in_real_logs(world, box, low, high):
    """Road users inside the box at 5 or more of 20 moments in 10 s.

    Nine real drives have 25 within +-50 m x +-25 m (each 9 to 44) and 14 within +-30 m x +-15 m (each 5 to 27). These
    are all actors, and real tracks miss a few.
    """
    counts = []
    for scene in range(12):
        log = simulate(scene, replace(world, keyframes=1), 100)
        (moment,) = log.keyframes
        counts.append(0)
        frames = moment.track_frame - 5 * np.arange(1, 21)
        to_ego = np.linalg.inv(moment.global_from_ego)
        there = np.zeros(len(log.actors.size), int)
        for frame in frames:
            at = log.actors.position[frame] @ log.global_from_ego[frame, :3, :3].T + log.global_from_ego[frame, :3, 3]
            at = at @ to_ego[:3, :3].T + to_ego[:3, 3]
            there += log.actors.valid[frame] & (np.abs(at[:, :2]) <= box).all(-1)
        counts[-1] = (there >= 5).sum()
    assert low < np.mean(counts) < high
    assert np.ptp(counts) > 0.5 * np.mean(counts)


# Means over the key frames with 10 s of history in +-50 m x +-25 m and +-30 m x +-15 m, and how often 30 is exceeded.
NUSCENES = {
    "0061": (43.7, 27.2, 1.0),
    "0655": (33.2, 15.8, 0.62),
    "0757": (15.5, 10.2, 0.0),
    "0796": (8.8, 4.6, 0.0),
    "1077": (12.4, 6.0, 0.0),
    "1094": (28.8, 11.8, 0.4),
    "1100": (21.4, 15.2, 0.0),
}


@pytest.mark.golden
def test_the_density_of_real_scenes_in_the_docs():
    """Road users valid in 5 or more of the 20 key frames before, inside the box of the current key frame."""
    means = []
    for scene, expected in NUSCENES.items():
        with np.load(shared_path(f"data/nuscenes_scenes/scene-{scene}.npz")) as data:
            user = np.array([name.startswith(("vehicle.", "human.pedestrian")) for name in data["category"]])
            position, valid = data["position"][:, user, :2], data["valid"][:, user].astype(bool)
            ego, yaw = data["ego_position"][:, :2], data["ego_yaw"]
        counts = []
        for now in range(20, len(position)):
            cos, sin = np.cos(yaw[now]), np.sin(yaw[now])
            at = (position[now - 20 : now] - ego[now]) @ np.array([[cos, -sin], [sin, cos]])
            inside = [valid[now - 20 : now] & (np.abs(at) <= box).all(-1) for box in BOXES]
            counts.append([(frames.sum(0) >= 5).sum() for frames in inside])
        wide, narrow = np.array(counts).T
        means.append((wide.mean(), narrow.mean(), (wide > 30).mean()))
        np.testing.assert_allclose(means[-1], expected, atol=0.05, err_msg=scene)
        assert not (narrow > 30).any()
    np.testing.assert_allclose(np.mean(means, 0), (23.4, 13.0, 0.29), atol=0.05)


def test_the_default_world_is_as_it_was():
    config = WorldConfig()
    assert (config.duration_s, config.rate_hz, config.keyframes) == (8.0, 10.0, 4)
    assert (config.traffic.variety, config.traffic.ego_passes_s, config.roads.junction_lanes) == (0.0, None, 3)
    assert [k.track_frame for k in simulate(3).keyframes] == [20, 40, 59, 79]
