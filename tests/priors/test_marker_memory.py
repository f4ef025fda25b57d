"""The temporal marker memory against a few lines of numpy: decay, retrieval, ego motion, scan and stream."""

import re
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tflane_jax.geometry import pose_matrix
from tflane_jax.priors.marker_memory import MarkerMemory, MarkerMemoryConfig, guidance, remember
from tflane_jax.priors.markers import MarkerLanes

CONFIG = MarkerMemoryConfig(frames=4, decay=0.5, exponent=0.5, threshold=0.2, gate="strongest")
LANES, POINTS = 3, 2
HERE = np.eye(4, dtype=np.float32)
step = jax.jit(remember, static_argnums=4)


def seen(trust, lanes=2, at=1.0):
    """Return a frame with some lanes of one marker, all points of the first one at (at, 0)."""
    out = MarkerLanes(
        points=np.full((LANES, POINTS, 2), np.nan, np.float32),
        confidence=np.zeros(LANES, np.float32),
        successor=np.zeros((LANES, LANES), bool),
        valid=np.arange(LANES) < lanes,
    )
    for i in range(lanes):
        out.points[i] = [at, float(i)]
        out.confidence[i] = trust
    out.points[lanes:] = 0.0
    return out


NOTHING = seen(0.0, lanes=0)


def run(frames, config=CONFIG, poses=None, starts=()):
    memory, out = MarkerMemory.empty(config.frames, LANES, POINTS), []
    for i, frame in enumerate(frames):
        pose = HERE if poses is None else poses[i]
        memory, used = step(memory, frame, pose, np.asarray(i > 0 and i not in starts), config)
        out.append(jax.tree.map(np.asarray, used))
    return memory, out


def test_a_trusted_frame_does_not_use_the_bank():
    _, (first, second) = run([seen(0.9, at=5.0), seen(0.6, at=7.0)])
    for used, trust, at in ((first, 0.9, 5.0), (second, 0.6, 7.0)):
        assert used.gate == pytest.approx(trust)
        np.testing.assert_array_equal(np.flatnonzero(used.valid), [0, 1])
        np.testing.assert_allclose(used.weight[used.valid], 1.0)
        np.testing.assert_array_equal(used.points[0], [[at, 0.0]] * POINTS)


def test_a_gap_is_filled_from_the_bank_with_decayed_confidence():
    frames = [seen(0.9, at=1.0), seen(0.4, lanes=1, at=2.0), NOTHING, NOTHING]
    _, out = run(frames)
    for now in (2, 3):
        used, weight = out[now], np.zeros((4, LANES))
        for frame, trust, lanes in ((0, 0.9, 2), (1, 0.4, 1)):
            age = now - frame
            weight[age, :lanes] = (trust * 0.5**age) ** 0.5
        np.testing.assert_allclose(used.weight.reshape(4, LANES), weight, rtol=1e-6)
        np.testing.assert_array_equal(used.valid.reshape(4, LANES), weight > 0)
        assert used.gate == pytest.approx(max(0.9 * 0.5**now, 0.4 * 0.5 ** (now - 1)))


def test_a_distrusted_frame_uses_the_bank_and_is_stored_in_it():
    _, out = run([seen(0.9), seen(0.1, at=3.0), NOTHING])
    assert out[1].gate == pytest.approx(0.45)
    np.testing.assert_allclose(out[1].weight.reshape(4, LANES)[:2, 0], np.sqrt([0.1, 0.45]), rtol=1e-6)
    np.testing.assert_allclose(out[2].weight.reshape(4, LANES)[1:3, 0], np.sqrt([0.05, 0.225]), rtol=1e-6)


def test_with_a_threshold_of_zero_only_gaps_are_filled():
    _, (_, weak, gap) = run([seen(0.9), seen(0.01, at=3.0), NOTHING], replace(CONFIG, threshold=0.0))
    assert weak.gate == pytest.approx(0.01)
    np.testing.assert_array_equal(np.flatnonzero(weak.valid), [0, 1])
    assert gap.gate == pytest.approx(0.9 * 0.5**2)
    assert gap.valid.sum() == 4


def test_a_long_union_keeps_its_heaviest_lanes_with_their_connectivity():
    pair = seen(0.9)
    pair.successor[0, 1] = True
    frames = [pair, seen(0.4, lanes=1, at=2.0), NOTHING]
    _, whole = run(frames)
    _, cut = run(frames, replace(CONFIG, lanes=2))
    _, enough = run(frames, replace(CONFIG, lanes=100))
    jax.tree.map(np.testing.assert_array_equal, enough, whole)
    # Of the bank's three lanes the two of the first frame weigh 0.9 / 4, that of the second 0.4 / 2.
    np.testing.assert_array_equal(cut[2].points[:, 0], [[1.0, 0.0], [1.0, 1.0]])
    np.testing.assert_allclose(cut[2].confidence, 0.9 / 4, rtol=1e-6)
    np.testing.assert_array_equal(cut[2].successor, [[False, True], [False, False]])
    np.testing.assert_array_equal(np.argwhere(whole[2].successor), [[2 * LANES, 2 * LANES + 1]])
    assert cut[2].gate == whole[2].gate
    assert cut[2].valid.all()
    _, cut = run([NOTHING], replace(CONFIG, lanes=2))
    assert not cut[0].valid.any()


def test_the_oldest_is_forgotten_and_a_new_scene_begins_empty():
    _, out = run([seen(0.9)] + [NOTHING] * 4)
    assert [bool(used.valid.any()) for used in out] == [True, True, True, True, False]
    assert out[4].gate == 0
    _, out = run([seen(0.9), NOTHING], starts=(1,))
    assert not out[1].valid.any()
    assert out[1].gate == 0


def test_remembered_lanes_stay_where_they_are_on_the_ground():
    # The vehicle drives 3 m ahead and turns left by 90 degrees.
    pose = pose_matrix(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([3.0, 0, 0])).astype(np.float32)
    frames, poses = [seen(0.9, at=5.0), NOTHING], [HERE, pose]
    _, out = run(frames, poses=poses)
    moved = out[1].points.reshape(4, LANES, POINTS, 2)[1, 0, 0]
    np.testing.assert_allclose(moved, [0.0, -2.0], atol=1e-6)
    _, out = run(frames, replace(CONFIG, compensation="none"), poses)
    np.testing.assert_array_equal(out[1].points.reshape(4, LANES, POINTS, 2)[1, 0, 0], [5.0, 0.0])


@pytest.mark.parametrize("exponent", [1.0, 0.5])
def test_a_remembered_token_is_scaled_once(exponent):
    """Gate times weight is the decayed confidence; with one marker all lanes have the weight 1, as in its own frame."""
    config = replace(CONFIG, gate="once", exponent=exponent)
    _, (present, gap) = run([seen(0.8), NOTHING], config)
    assert present.gate == pytest.approx(0.8)
    assert gap.gate == pytest.approx(0.4)
    for used in (present, gap):
        np.testing.assert_allclose(used.weight[used.valid], 1.0, rtol=1e-6)
    _, (*_, both) = run([seen(0.8), seen(0.1, lanes=1, at=3.0), NOTHING], config)
    total = both.gate * both.weight.reshape(4, LANES)
    np.testing.assert_allclose(total[2, :2], 0.2, rtol=1e-6)
    np.testing.assert_allclose(total[1, 0], 0.2 * (0.05 / 0.2) ** exponent, rtol=1e-6)
    assert MarkerMemoryConfig().gate == "once"


def test_without_decay_confidence_stays_and_the_gate_can_be_one():
    frames = [seen(0.9)] + [NOTHING] * 3
    _, out = run(frames, replace(CONFIG, decay=1.0))
    assert out[3].gate == pytest.approx(0.9)
    _, out = run(frames, replace(CONFIG, gate="one"))
    assert [float(used.gate) for used in out] == pytest.approx([0.9, 1.0, 1.0, 1.0])
    _, out = run([NOTHING], replace(CONFIG, gate="one"))
    assert out[0].gate == 0


def test_a_second_marker_counts_relative_to_the_first():
    both = seen(0.8)
    both.confidence[1] = 0.2
    used = guidance(both, 0.5)
    assert used.gate == pytest.approx(0.8)
    np.testing.assert_allclose(used.weight, [1.0, 0.5, 0.0], rtol=1e-6)


def frames_and_poses(count=7):
    rng = np.random.default_rng(0)
    frames = [seen(rng.uniform(), lanes=int(rng.integers(0, LANES + 1)), at=rng.uniform(0, 9)) for _ in range(count)]
    poses = np.tile(HERE, (count, 1, 1))
    poses[:, 0, 3] = rng.uniform(0, 5, count)
    return frames, poses


def test_scan_equals_stream_bit_for_bit_and_is_traced_once():
    frames, poses = frames_and_poses()
    traces = []

    @jax.jit
    def every(frames, poses, going):
        def body(memory, now):
            traces.append(None)
            return remember(memory, *now, CONFIG)

        return lax.scan(body, MarkerMemory.empty(4, LANES, POINTS), (frames, poses, going))

    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *frames)
    going = np.arange(len(frames)) > 0
    last, scanned = every(stacked, poses, going)
    memory, out = run(frames, poses=poses)
    jax.tree.map(np.testing.assert_array_equal, last, memory)
    jax.tree.map(np.testing.assert_array_equal, scanned, jax.tree.map(lambda *leaves: np.stack(leaves), *out))
    seen_otherwise = jax.tree.map(lambda leaf: leaf[::-1].copy(), stacked)
    every(seen_otherwise, poses, going)
    assert len(traces) == 1


def test_gradients_are_finite_where_nothing_was_seen():
    def total(trust):
        frame = NOTHING.replace(confidence=trust)
        return partial(remember, config=CONFIG)(MarkerMemory.empty(4, LANES, POINTS), frame, HERE, np.asarray(False))[
            1
        ].weight.sum()

    assert np.isfinite(jax.grad(total)(jnp.zeros(LANES))).all()


def test_a_stream_keeps_its_numbers_and_dtypes_in_64_bit_mode():
    """Regression: the bank became float64 after the first frame, and a scan over frames was refused."""
    frames, poses = frames_and_poses()
    stacked, going = jax.tree.map(lambda *leaves: np.stack(leaves), *frames), np.arange(len(frames)) > 0
    _, expected = run(frames, poses=poses)
    with jax.enable_x64(True):
        last, used = lax.scan(
            lambda memory, now: remember(memory, *now, CONFIG),
            jax.tree.map(jnp.asarray, MarkerMemory.empty(4, LANES, POINTS)),
            (stacked, poses, going),
        )
    assert [leaf.dtype for leaf in jax.tree.leaves(last)] == [np.float32, np.float32, bool, bool]
    for name, leaf in vars(used).items():
        assert leaf.dtype in (np.float32, bool)
        np.testing.assert_allclose(leaf, np.stack([getattr(one, name) for one in expected]), rtol=1e-5, atol=1e-6)


def test_a_frame_at_the_threshold_is_trusted():
    _, (_, used) = run([seen(0.9, at=5.0), seen(0.25, at=7.0)], replace(CONFIG, threshold=0.25))
    np.testing.assert_array_equal(np.flatnonzero(used.valid), [0, 1])
    assert used.gate == 0.25


def test_remembered_places_of_the_plane_stay_where_they_are_if_the_vehicle_pitches():
    """The bank has no heights: what counts are the points of the present plane, seen from the previous frame."""
    cos, sin = np.cos(0.3), np.sin(0.3)
    pitch, roll = np.eye(3), np.eye(3)
    pitch[[0, 0, 2, 2], [0, 2, 0, 2]] = cos, sin, -sin, cos
    roll[[1, 1, 2, 2], [1, 2, 1, 2]] = cos, -sin, sin, cos
    pose = pose_matrix(pitch @ roll, np.array([2.0, -1.0, 0.0])).astype(np.float32)
    places = np.array([[10.0, 3.0], [-4.0, 6.0]], np.float32)
    before = seen(0.9, lanes=1)
    before.points[0] = (np.c_[places, np.zeros(2), np.ones(2)] @ pose.T)[:, :2]
    _, (_, used) = run([before, NOTHING], poses=[HERE, pose])
    np.testing.assert_allclose(used.points[used.valid][0], places, atol=1e-4)


@pytest.mark.parametrize(("frames", "lanes", "points"), [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_a_memory_of_another_size_is_named(frames, lanes, points):
    right = CONFIG.frames, LANES, POINTS
    wrong = CONFIG.frames + frames, LANES + lanes, POINTS + points
    found, wanted = (re.escape(f"MarkerMemory.empty{size}") for size in (wrong, right))
    with pytest.raises(ValueError, match=rf"the memory is {found}, .* need {wanted}"):
        remember(MarkerMemory.empty(*wrong), seen(0.9), HERE, np.asarray(False), CONFIG)
