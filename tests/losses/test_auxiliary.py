"""Losses of denoised lanes, of which every copy is compared with its own example, and of lane proposals in a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tflane_jax.geometry import PerceptionRange
from tflane_jax.losses.auxiliary import auxiliary_losses, denoising_pairs
from tflane_jax.losses.common import declared_outputs
from tflane_jax.losses.lane_weights import LaneWeights
from tflane_jax.losses.maptr import MapTrLossConfig
from tflane_jax.models.auxiliary import AuxiliaryOutputs, LaneProposalOutputs
from tflane_jax.scene import CenterlinePrediction, LaneGraph


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


def test_proposal_losses_of_equal_examples_do_not_depend_on_their_number():
    rng = np.random.default_rng(0)
    lanes = LaneGraph.empty(2, 5)
    lanes.points[0], lanes.valid[0] = rng.normal(size=(5, 3)), True
    heat, shapes = (jnp.asarray(rng.normal(size=size)) for size in ((4, 6, 8), (2, 5, 3)))
    outputs = LaneProposalOutputs(heat=heat, lanes=shapes)

    def report(copies):
        truth, proposals = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * copies), (lanes, outputs))
        terms = auxiliary_losses(
            AuxiliaryOutputs(lane_proposals=proposals),
            ("lane_proposals",),
            truth,
            weights=LaneWeights(proposal_weight=1.5, points_weight=0.5),
            bev_range=PerceptionRange(),
            denoising=lambda *_: {},
        )[1]
        return {name: float(value) for name, value in terms.items()}

    assert report(2) == pytest.approx(report(1), rel=1e-5)


@pytest.mark.parametrize(
    ("outputs", "name", "message"),
    [
        (AuxiliaryOutputs(), "lane_cells", "lane_cells, but it is missing: sow it in the model"),
        (AuxiliaryOutputs(line_mask=jnp.zeros((1, 2, 3))), "line_mask", "line_mask has no loss: add a branch"),
    ],
)
def test_an_output_that_is_missing_and_one_without_a_loss_are_two_faults(outputs, name, message):
    truth = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], LaneGraph.empty(2, 5))
    settings = {"weights": LaneWeights(), "bev_range": PerceptionRange(), "denoising": lambda *_: {}}
    with pytest.raises(ValueError, match=message):
        auxiliary_losses(outputs, (name,), truth, **settings)
    if outputs.line_mask is not None:
        with pytest.raises(ValueError, match=f"{message} to auxiliary_terms"):
            MapTrLossConfig().auxiliary_terms(name, outputs.line_mask, truth, truth, None)


def test_declared_outputs_come_in_the_order_of_the_host():
    outputs = AuxiliaryOutputs(line_mask=jnp.zeros(1), lane_cells=jnp.ones(2))
    for names in (("line_mask", "lane_cells"), ("lane_cells", "line_mask"), ()):
        found = list(declared_outputs(outputs, names))
        assert [name for name, _ in found] == list(names)
        assert all(value is getattr(outputs, name) for name, value in found)
    # What comes before a missing one is computed first.
    rest = declared_outputs(outputs, ("lane_cells", "denoised"))
    assert next(rest)[0] == "lane_cells"
    with pytest.raises(ValueError, match="denoised, but it is missing: sow it in the model"):
        next(rest)
