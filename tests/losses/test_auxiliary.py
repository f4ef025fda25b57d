"""Losses of denoised lanes: every copy is compared with the ground truth of its own example."""

import jax.numpy as jnp
import numpy as np

from tflane_jax.losses.auxiliary import denoising_pairs
from tflane_jax.scene import CenterlinePrediction


def test_every_copy_has_the_truth_of_its_own_example_and_every_query_its_own_lane():
    """Two examples, three copies, two queries; four lanes, of which the last two have no query."""
    example, copy = np.meshgrid(np.arange(2), np.arange(3), indexing="ij")
    points = np.broadcast_to((10.0 * example + copy)[..., None, None, None, None], (2, 3, 1, 2, 5, 3))
    prediction = CenterlinePrediction(jnp.asarray(points, jnp.float32), jnp.zeros((2, 3, 1, 2, 1)))
    valid = jnp.array([[True, True, True, True], [True, False, True, False]])
    pairs, assignment, truth = denoising_pairs(prediction, {"example": jnp.arange(2)}, valid)
    assert pairs.points.shape == (6, 1, 2, 5, 3)
    assert sorted(pairs.points[:, 0, 0, 0, 0].tolist()) == [0.0, 1.0, 2.0, 10.0, 11.0, 12.0]
    np.testing.assert_array_equal(pairs.points[:, 0, 0, 0, 0] // 10, truth["example"])
    for row, of in enumerate(truth["example"].tolist()):
        assert assignment.matched[row, 0].tolist() == [True, of == 0, False, False]
        assert assignment.query[row, 0].tolist() == [0, int(of == 0), 0, 0]
