"""Places for marker boards that drivers see: a surveyor does not put a board behind a mast."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tflane_jax.scene.logs import VectorMap
from tflane_jax.world.bev.line_of_sight import hidden_points, occluders_from
from tflane_jax.world.cameras.stage import map_boxes
from tflane_jax.world.roads.markers import Visible

# Viewpoints of drivers: distances before the board, and to its side towards the road, metres; height of a camera.
VIEWS = tuple((ahead, aside) for ahead in (8.0, 14.0, 22.0, 35.0, 50.0) for aside in (3.0, 6.0))
_EYE = 1.45
# Points of a board that are tested, from its middle, as fractions of the side of its black square.
_ACROSS = np.linspace(-0.6, 0.6, 7)


def visible_places(vector_map: VectorMap, seed: int, size: float = 1.0, *, on_left: bool = False) -> Visible:
    """Return the function that gives the fraction of a board that drivers see, in the scene of this map and seed.

    It is the mean over `VIEWS` of the fraction that no static body hides; road users do not count.

    Args:
        vector_map: as it is shown.
        seed: of the scene.
        size: side of the black square, metres.
        on_left: traffic keeps to the left, so that drivers are to the right of a board.
    """
    boxes, towards_road = map_boxes(vector_map, seed), -1.0 if on_left else 1.0
    reach = max(ahead for ahead, _ in VIEWS) + 10.0

    def visible(place: Float[np.ndarray, "3"], heading: float) -> float:
        along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        near = boxes[np.hypot(*(boxes[:, :2] - place[:2]).T) < reach + 0.5 * np.hypot(boxes[:, 2], boxes[:, 3])]
        across, up = (size * axis.ravel() for axis in np.meshgrid(_ACROSS, _ACROSS))
        points = place[:2] + across[:, None] * left
        hidden = []
        for ahead, aside in VIEWS:
            eye = place[:2] - ahead * along + towards_road * aside * left
            hidden.append(
                hidden_points(
                    points - eye,
                    occluders_from(near, eye),
                    np.zeros((0, 5)),
                    sensor_height=_EYE,
                    target_height=place[2] + up,
                ).mean()
            )
        return 1.0 - float(np.mean(hidden))

    return visible
