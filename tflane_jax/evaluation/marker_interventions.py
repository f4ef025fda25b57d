"""Interventions on the markers that a trained model sees: what does it predict if a board is wrong?"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from tflane_jax.errors import UserError
from tflane_jax.scene import Example

WrongMarker = Literal["detection", "store"]
"""What is wrong: the detected pose of this frame alone, or the lanes in the store, in every frame alike."""


def displaced_markers(examples: Example, offset: Float[np.ndarray, "2"], wrong: WrongMarker) -> Example:
    """Return the examples with the lanes of all their markers displaced, and everything else unchanged.

    A wrong detection displaces the marker too, and its residual r of Eq. (2) grows by the length of the offset, as if
    the previous detection had been right. A wrong store leaves both as they are: nothing in Eq. (2) can notice it.

    Args:
        examples: one frame, or several with leading axes.
        offset: (x, y) in the ego frame, metres.
        wrong: see `WrongMarker`.

    Raises:
        UserError: the examples have no markers.
    """
    markers: Any = examples.markers
    if markers is None:
        raise UserError("these examples have no markers, so none can be displaced (data.example.markers)")
    shift = np.append(np.asarray(offset, np.float32), np.float32(0.0))
    lanes = np.where(np.asarray(markers.lane_valid)[..., None, None], markers.lanes + shift, markers.lanes)
    markers = replace(markers, lanes=lanes)
    if wrong == "detection":
        pose, valid = np.array(markers.pose), np.asarray(markers.valid)
        pose[..., :3, 3] += np.where(valid[..., None], shift, np.float32(0.0))
        further = np.where(valid, np.hypot(*shift[:2]), np.float32(0.0))
        markers = replace(markers, pose=pose, residual=markers.residual + further)
    return replace(examples, markers=markers)
