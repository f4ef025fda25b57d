"""The Argoverse 2 reader on the two real logs, against counts of all categories and lane types in the raw files."""

import functools

import numpy as np
import pytest

from tests.shared import shared_path
from tflane_jax.datasets.argoverse2_log import CATEGORIES, load_log
from tflane_jax.datasets.base import ExampleConfig
from tflane_jax.datasets.examples import make_example, traffic_flow
from tflane_jax.datasets.map_lines import MapLinesConfig
from tflane_jax.geometry import PerceptionRange
from tflane_jax.scene import AreaType, LineClass, RoadUser

pytest.importorskip("pyarrow")

FLAT = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
FORKED = "adcf7d18-0510-35b0-a2fa-b4cea13a6d76"
EVERYTHING = dict.fromkeys(CATEGORIES, RoadUser.CAR)
RANGE = PerceptionRange()


@functools.cache
def real_log(name, categories):
    return load_log(
        shared_path(f"data/argoverse2/sensor/val/{name}"),
        openlane=shared_path("data/openlanev2"),
        categories=EVERYTHING if categories == "all" else CATEGORIES,
    )


@functools.cache
def real_examples(name):
    config = ExampleConfig(tracks=160)
    return [make_example(real_log(name, "traffic"), i, config) for i in range(32)]


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "boxes", "all_tracks", "lengths", "furniture"),
    [(FLAT, 11364, 114, (121.5, 112, 104), 676 + 118), (FORKED, 12078, 146, (74, 141, 130), 1699 + 600 + 332)],
)
def test_real_tracks(name, boxes, all_tracks, lengths, furniture):
    log = real_log(name, "all")
    valid = log.tracks.valid
    assert valid.shape == (156, all_tracks)
    assert valid.sum() == boxes
    frames = valid.sum(0)
    assert (np.median(frames), (frames >= 5).sum(), (frames >= 20).sum()) == lengths
    assert real_log(name, "traffic").tracks.valid.sum() == boxes - furniture
    # Every track is one unbroken run.
    assert (np.abs(np.diff(valid.astype(int), axis=0)).sum(0) <= 2).all()
    assert 0.1 < log.tracks.occluded[valid].mean() < 0.25
    assert [k.track_frame for k in log.keyframes][:5] == [0, 5, 10, 15, 20]
    nearest = log.timestamps_ns[[k.track_frame for k in log.keyframes]]
    early = nearest - [k.timestamp_ns for k in log.keyframes]
    assert (early > 9.3e6).all()
    assert (early < 10.8e6).all()


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "means", "largest", "crowded"), [(FLAT, (30.2, 29.2, 27.4), 39, 18), (FORKED, (30.2, 29.6, 28.2), 41, 14)]
)
def test_real_histories(name, means, largest, crowded):
    counts = []
    for i in range(32):
        flow, dropped = traffic_flow(real_log(name, "all"), i, history=20, capacity=160)
        assert dropped == 0
        inside = (flow.valid & RANGE.contains(flow.position)).sum(-1)
        counts.append([(inside >= least).sum() for least in (1, 5, 10)])
    assert np.mean(counts, 0).round(1).tolist() == list(means)
    assert np.max(counts) == largest
    assert (np.array(counts)[:, 1] > 30).sum() == crowded


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "counts", "means"),
    [
        pytest.param(
            FLAT,
            [[38, 21, 27], [40, 21, 27], [19, 12, 20], [21, 12, 20], [4, 4, 4], [4, 4, 7]],
            (25.2, 25.2, 14.4, 14.4),
            marks=pytest.mark.slow,
        ),
        (
            FORKED,
            [[52, 52, 55], [53, 53, 56], [26, 26, 28], [27, 27, 29], [4, 4, 4], [4, 4, 4]],
            (53.7, 54.6, 26.9, 27.8),
        ),
    ],
)
def test_real_ground_truth(name, counts, means):
    found = [
        [
            e.segments.valid.sum(),
            e.segments.successor.sum(),
            e.lanes.valid.sum(),
            e.lanes.successor.sum(),
            (e.areas.category[e.areas.valid] == AreaType.PEDESTRIAN_CROSSING).sum(),
            (e.areas.category[e.areas.valid] == AreaType.ROAD_BOUNDARY).sum(),
        ]
        for e in real_examples(name)
    ]
    assert np.array(found)[[0, 15, 31]].T.tolist() == counts
    assert np.mean(found, 0)[:4].round(1).tolist() == list(means)


@pytest.mark.golden
@pytest.mark.parametrize("name", [FLAT, FORKED])
def test_real_truth_is_where_it_should_be(name):
    for number, example in enumerate(real_examples(name)):
        example.validate()
        for graph in (example.lanes, example.segments):
            lines = graph.points[graph.valid]
            assert RANGE.contains(lines).all()
            # Measured at every fourth frame; in others the vehicle pitches and far lanes rise or sink further.
            if number % 4 == 0:
                assert -1.55 < lines[..., 2].min() < lines[..., 2].max() < 1.15
            i, j = np.nonzero(graph.successor)
            np.testing.assert_allclose(graph.points[i, -1], graph.points[j, 0], atol=2e-3)
            # The centerline runs between its boundaries: the left one lies to the left.
            heading = lines[:, 6] - lines[:, 4]
            across = (graph.left - graph.right)[graph.valid][:, 5]
            assert (heading[:, 0] * across[:, 1] - heading[:, 1] * across[:, 0] > 0).all()
        ground = example.lanes.points[example.lanes.valid].reshape(-1, 3)
        nearest = np.linalg.norm(ground[:, :2], axis=-1).argmin()
        assert ground[nearest, 2] == pytest.approx(-0.33, abs=0.15)
        assert 0.0 < example.hidden.mean() < 0.9


@pytest.mark.golden
@pytest.mark.parametrize("name", [FLAT, FORKED])
def test_real_traffic_keeps_to_the_lanes(name):
    """Cars that move drive along a lane segment: their own poses and the map agree."""
    agree = []
    for example in real_examples(name)[4::7]:
        flow, lanes = example.traffic_flow, example.segments
        step = flow.position[:, -1, :2] - flow.position[:, -6, :2]
        fast = flow.valid[:, -1] & flow.valid[:, -6] & (flow.category == RoadUser.CAR)
        fast &= np.linalg.norm(step, axis=-1) > 2.0
        fast &= PerceptionRange((-45, 45), (-20, 20)).contains(flow.position[:, -1])
        for k in np.flatnonzero(fast):
            starts, ends = lanes.points[lanes.valid][:, :-1, :2], lanes.points[lanes.valid][:, 1:, :2]
            near = np.linalg.norm((starts + ends) / 2 - flow.position[k, -1, :2], axis=-1) < 3.5
            heading = (ends - starts)[near]
            heading /= np.linalg.norm(heading, axis=-1, keepdims=True)
            agree.append(bool(((heading @ step[k]) / np.linalg.norm(step[k]) > 0.9).any()))
    assert len(agree) > 5
    assert np.mean(agree) > 0.85


@pytest.mark.golden
@pytest.mark.parametrize(
    ("name", "counts"),
    # By class: dividers, crossings, boundaries, centerlines, summed over the 32 key frames in MapTR's patch.
    [(FLAT, (64, 43, 102, 211)), (FORKED, (178, 47, 94, 466))],
)
def test_real_map_lines(name, counts):
    config = MapLinesConfig(lines=32, centerlines="include")
    example = ExampleConfig(range=PerceptionRange((-30.0, 30.0), (-15.0, 15.0)), map_lines=config, sensor=None)
    found = [make_example(real_log(name, "traffic"), i, example).map_lines for i in range(32)]
    total = sum(np.bincount(lines.category[lines.valid], minlength=4) for lines in found)
    assert tuple(total.tolist()) == counts
    for lines in found:
        points, category = lines.points[lines.valid], lines.category[lines.valid]
        assert example.range.contains(points.round(4)).all()
        assert lines.closed[lines.valid][category == LineClass.CROSSING].all()
        assert np.abs(points[..., 2]).max() < 2.0
        # Dividers lie between boundaries: none of them touches a boundary.
        dividers, boundaries = (points[category == kind][..., :2] for kind in (LineClass.DIVIDER, LineClass.BOUNDARY))
        gap = np.linalg.norm(dividers[:, :, None, None] - boundaries[None, None], axis=-1).min((1, 2, 3))
        assert (gap > 0.5).all()
