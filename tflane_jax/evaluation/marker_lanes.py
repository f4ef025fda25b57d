"""The lanes of markers as if they were a prediction: what a prior knows by itself, without any sensor.

A model with markers can be compared with it: what it finds beyond both this and the model without markers is not in
either input alone, and what it misses of this is knowledge that it does not use.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from tflane_jax.errors import UserError
from tflane_jax.layers.positions import inverse_sigmoid
from tflane_jax.models.host import HostConfig
from tflane_jax.models.marker_fusion import as_fused
from tflane_jax.models.prior import Prior
from tflane_jax.scene import CenterlinePrediction, Example, Prediction


@dataclass(frozen=True)
class MarkerLanes:
    """A predictor (`evaluation.predict.Predictor`) that answers with the lanes of the marker prior of a host.

    A lane's score is the factor of its token in Eq. (3): c times its weight of Eq. (4).

    Attributes:
        model: a host with a marker prior.
        remembers: with the prior's memory, if it has one: `task.streams` of the model that is compared with, because
            one that was trained on single frames does not use its memory.

    Raises:
        UserError: the host has no marker prior.
    """

    model: HostConfig
    remembers: bool = True

    def __post_init__(self) -> None:
        if self.model.priors.markers is None:
            raise UserError("this model has no marker prior, so there are no lanes to show (task.model.priors.markers)")

    @property
    def streams(self) -> bool:
        """Whether frames are processed in order, with the prior's memory."""
        return self.start() is not None

    def start(self) -> Any:
        """Return an empty memory, None for none."""
        return self._prior.start() if self.remembers else None

    def predict(self, params: Any, example: Example) -> Prediction:
        """Return the lanes of the frame's own markers."""
        return self.step(params, None, example)[1]

    def step(self, params: Any, memory: Any, example: Example) -> tuple[Any, Prediction]:
        """Return the memory for the next frame, and the lanes that enter Eq. (3); there are no parameters."""
        del params
        observed, memory = self._prior.observe(example, memory)
        config: Any = self.model.priors.markers
        lanes = as_fused(observed, config)
        logits = inverse_sigmoid(jnp.where(lanes.valid, lanes.weight * lanes.gate, 0.0), eps=1e-6)
        points = jnp.pad(jnp.where(lanes.valid[:, None, None], lanes.points, 0.0), ((0, 0), (0, 0), (0, 1)))
        return memory, Prediction(centerlines=CenterlinePrediction(points, logits[:, None]))

    @property
    def _prior(self) -> Prior:
        return self.model.build_priors()["markers"]
