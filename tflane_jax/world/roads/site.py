"""The parts of a laid-out road network besides its lane segments: streets, kerbs, islands, crossings, elements."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from tflane_jax.scene.logs import MapElement
from tflane_jax.world.roads.streets import Street


@dataclass
class Site:
    """Streets, kerbs, crossings and traffic elements produced by the layout so far.

    Attributes:
        streets: all of them.
        kerbs: outer edges of the drivable surface; each line has the road on its left and the block on its right.
        islands: closed rings inside the drivable surface (medians, roundabout islands).
        crossings: closed rings of pedestrian crossings.
        elements: traffic lights and signs.
        urban: pedestrians walk behind the kerbs, and buildings are close to the road.
    """

    streets: list[Street]
    kerbs: list[Float[np.ndarray, "n 2"]]
    islands: list[Float[np.ndarray, "n 2"]] = field(default_factory=list)
    crossings: list[Float[np.ndarray, "5 2"]] = field(default_factory=list)
    elements: list[MapElement] = field(default_factory=list)
    urban: bool = True
