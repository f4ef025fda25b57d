"""The task "predict the lane graph": a host model, its loss and its answer, as the training program wants them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import jax
from jaxtyping import Array, Float

from tflane_jax.losses.lane_graph import LaneGraphLossConfig, lane_graph_loss
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.scene import Example, LanePrediction, Prediction


@dataclass(frozen=True)
class LaneGraphTask:
    """A TopoNet-family host with the lane-graph loss; hashable, so that jit takes it as a static argument.

    Attributes:
        model: the host, with or without priors.
        losses: weights of costs and losses.
    """

    model: TopoNetConfig = TopoNetConfig()
    losses: LaneGraphLossConfig = LaneGraphLossConfig()

    def init(self, key: jax.Array, example: Example) -> dict[str, Any]:
        """Return fresh parameters; `example` gives shapes only."""
        return dict(self.model.build().init(key, example)["params"])

    def loss(
        self, params: dict[str, Any], batch: Example, key: jax.Array
    ) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        """Return the loss of a batch (leading axis on every leaf) and its terms; `key` is for dropout, unused here."""
        del key
        module = self.model.build()
        outputs = jax.vmap(lambda example: module.apply({"params": params}, example))(batch)
        return lane_graph_loss(cast(LanePrediction, outputs), batch.lanes, self.losses)

    def predict(self, params: dict[str, Any], example: Example) -> Prediction:
        """Return the last decoder layer's answer for one example."""
        outputs = self.model.build().apply({"params": params}, example)
        return Prediction(lanes=jax.tree.map(lambda layers: layers[-1], outputs))
