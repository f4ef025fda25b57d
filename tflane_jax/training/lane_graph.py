"""The task "predict the lane graph": a host model, its loss and its answer, as the training program wants them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
from jaxtyping import Array, Float

from tflane_jax.errors import UserError
from tflane_jax.layers.batch_norm import BATCH_AXIS
from tflane_jax.losses.lane_graph import LaneGraphLossConfig, lane_graph_loss
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.scene import Example, Prediction
from tflane_jax.training.task import STATISTICS, Params, split_statistics


@dataclass(frozen=True)
class LaneGraphTask:
    """A TopoNet-family host with the lane-graph loss; hashable, so that jit takes it as a static argument.

    Attributes:
        model: the host, with or without priors.
        losses: weights of costs and losses.
    """

    model: TopoNetConfig = TopoNetConfig()
    losses: LaneGraphLossConfig = LaneGraphLossConfig()

    def init(self, key: jax.Array, example: Example) -> Params:
        """Return fresh parameters; `example` gives shapes only."""
        variables = self.model.build().init(key, example)
        return dict(variables["params"]) | {name: variables[name] for name in (STATISTICS,) if name in variables}

    def loss(self, params: Params, batch: Example, key: jax.Array) -> tuple[Float[Array, ""], dict[str, Any]]:
        """Return the loss of a batch (leading axis on every leaf) and its terms; `key` is for dropout."""
        learned, statistics = split_statistics(params)
        module, keys = self.model.build(), jax.random.split(key, len(batch.has_previous))

        def one(example, key):
            variables, streams = {"params": learned} | statistics, {"dropout": key}
            outputs, updated = module.apply(variables, example, train=True, mutable=[STATISTICS], rngs=streams)
            return outputs, dict(updated)

        outputs, updated = jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, None))(batch, keys)
        if outputs.elements is None:
            loss, terms = lane_graph_loss(outputs, batch.lanes, self.losses)
        elif batch.traffic_elements is None or batch.cameras is None:
            raise UserError(
                "the model predicts traffic elements, and these data label none: choose data with front images and "
                "traffic elements, or set task.model.elements to None"
            )
        else:
            sizes = batch.cameras.size[:, 0]
            loss, terms = lane_graph_loss(outputs, batch.lanes, self.losses, batch.traffic_elements, sizes)
        return loss, terms | updated

    def predict(self, params: Params, example: Example) -> Prediction:
        """Return the last decoder layer's answer for one example."""
        learned, statistics = split_statistics(params)
        outputs = self.model.build().apply({"params": learned} | statistics, example)
        return jax.tree.map(lambda layers: layers[-1], outputs)
