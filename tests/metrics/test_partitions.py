"""Groups of true lanes by distance."""

import numpy as np
import pytest

from tflane_jax.metrics import LaneTruth
from tflane_jax.metrics.partitions import ByDistance


@pytest.mark.parametrize(
    ("nearest", "group"),
    [
        ((0.0, 0.0, 0.0), "0 to 10 m"),
        ((-9.5, 0.0, 5.0), "0 to 10 m"),  # on the ground; in space it is 10.7 m away
        ((6.0, 8.0, 0.0), "10 to 20 m"),  # an edge begins the next group
        ((0.0, 20.0, 0.0), "20 to 30 m"),
        ((30.0, 0.0, 0.0), "from 30 m"),
    ],
)
def test_the_nearest_vertex_on_the_ground_decides(nearest, group):
    far = np.array([100.0, 0.0, 0.0])
    truth = LaneTruth([np.array([far, nearest, far])], np.zeros((1, 1), bool))
    groups = ByDistance()
    assert [name for name in groups.names if groups.members(name, truth)] == [group]
