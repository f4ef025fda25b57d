"""The task "find the lane lines of one image": the LSTR family with its fitting loss, as training wants it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
from jaxtyping import Array, Float

from tflane_jax.layers.batch_norm import BATCH_AXIS
from tflane_jax.losses.lane_shape import LaneShapeLossConfig, cell_loss, lane_shape_loss, lane_shape_targets
from tflane_jax.models.auxiliary import AUXILIARY
from tflane_jax.models.lstr import LstrConfig, normalise
from tflane_jax.scene import LaneShapePrediction, RoadImage
from tflane_jax.training.task import STATISTICS, Params, split_statistics


@dataclass(frozen=True)
class LaneShapeTask:
    """A network of the LSTR family; hashable, so that jit takes it as a static argument.

    Attributes:
        model: the network.
        losses: weights of costs and losses.
    """

    model: LstrConfig = LstrConfig()
    losses: LaneShapeLossConfig = LaneShapeLossConfig()

    def init(self, key: jax.Array, example: RoadImage) -> Params:
        """Return fresh parameters; `example` gives shapes only."""
        variables = self.model.build().init(key, normalise(example.image, example.image_valid), example.image_valid)
        return dict(variables["params"]) | {STATISTICS: variables["batch_stats"]}

    def loss(self, params: Params, batch: RoadImage, key: jax.Array) -> tuple[Float[Array, ""], dict[str, Any]]:
        """Return the loss of a batch (leading axis on every leaf) and its terms; norms use the batch's statistics."""
        learned, statistics = split_statistics(params)
        module, keys = self.model.build(), jax.random.split(key, len(batch.image))

        def one(image, valid, key):
            variables = {"params": learned} | statistics
            prediction, updated = module.apply(
                variables, image, valid, train=True, mutable=[STATISTICS, AUXILIARY], rngs={"dropout": key}
            )
            state: dict[str, Any] = dict(updated)
            return prediction, state.get(AUXILIARY, {}), state[STATISTICS]

        images = normalise(batch.image, batch.image_valid)
        train = jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, 0, None))
        prediction, auxiliary, updated = train(images, batch.image_valid, keys)
        targets = lane_shape_targets(batch.lines, shared_horizon=self.losses.shared_horizon)
        loss, terms = lane_shape_loss(prediction, targets, self.losses)
        if self.model.cells:
            terms["cells"] = self.losses.cell_weight * jax.vmap(cell_loss)(auxiliary["cells"][0], targets).mean()
            loss += terms["cells"]
        return loss, terms | {STATISTICS: updated}

    def predict(self, params: Params, example: RoadImage) -> LaneShapePrediction:
        """Return the last decoder layer's answer for one example; its lines are not looked at."""
        learned, statistics = split_statistics(params)
        image = normalise(example.image, example.image_valid)
        layers = self.model.build().apply({"params": learned} | statistics, image, example.image_valid)
        return jax.tree.map(lambda leaf: leaf[-1], layers)
