"""The 18 numbers of the CAN bus: which message, which frame, what is an error."""

import json

import numpy as np
import pytest

from tests.datasets.nuscenes_small import EAST, NORTH, START
from tflane_jax.datasets.nuscenes_can_bus import can_bus
from tflane_jax.errors import UserError

POSES = [
    {
        "utime": START + 20_000 * i,
        "pos": [9.0, 9.0, 9.0],
        "orientation": [1.0, 0.0, 0.0, 0.0],
        "accel": [i, 0.1, 9.8],
        "rotation_rate": [0.0, 0.0, 10 + i],
        "vel": [20 + i, 0.0, 0.0],
    }
    for i in range(3)
]


@pytest.mark.parametrize(
    ("late", "rules", "message"),
    [
        (0, "plain", 0),
        (30_000, "plain", 1),
        (-5, "plain", 0),
        (10**6, "plain", 2),
        # The published code takes the motion of the message after the key frame.
        (0, "reference", 1),
        (30_000, "reference", 2),
        (-5, "reference", 0),
        (10**6, "reference", 2),
    ],
)
def test_can_bus(tmp_path, late, rules, message):
    (tmp_path / "scene-0061_pose.json").write_text(json.dumps(POSES))
    found = can_bus(
        tmp_path, "scene-0061", (START + late) * 1000, np.array([4.0, 5.0, 0.0]), np.array(NORTH), rules=rules
    )
    assert found.shape == (18,)
    assert found[:3].tolist() == [4, 5, 0]
    np.testing.assert_allclose(found[3:7], NORTH if rules == "plain" else [NORTH[0]] * 4)
    assert found[7:16].tolist() == [message, 0.1, 9.8, 0, 0, 10 + message, 20 + message, 0, 0]
    np.testing.assert_allclose(found[16:], [np.pi / 2, 90.0])


def test_can_bus_without_messages(tmp_path):
    found = can_bus(tmp_path, "scene-0161", START * 1000, np.zeros(3), np.array([NORTH[0], 0, 0, -NORTH[0]]))
    assert not found[7:16].any()
    np.testing.assert_allclose(found[16:], [1.5 * np.pi, 270.0])  # yaw runs from 0 to 2 pi
    for content in ([], {"a": 1}, POSES[::-1], [{"utime": 1.5}], [POSES[0] | {"vel": [1.0, float("nan"), 0.0]}]):
        (tmp_path / "scene-0061_pose.json").write_text(json.dumps(content))
        with pytest.raises(UserError, match="scene-0061_pose"):
            can_bus(tmp_path, "scene-0061", START * 1000, np.zeros(3), np.array(EAST))
    with pytest.raises(UserError, match=r"scene-0001_pose\.json"):
        can_bus(tmp_path, "scene-0001", START * 1000, np.zeros(3), np.array(EAST))
