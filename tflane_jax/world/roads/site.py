"""The parts of a laid-out road network besides its lane segments: streets, kerbs, islands, crossings, elements."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from tflane_jax.scene.logs import MapElement
from tflane_jax.world.roads.streets import Street


@dataclass(frozen=True)
class Driveway:
    """A short way from the road to a plot, across the kerb.

    Attributes:
        kerb: number of the kerb that it interrupts.
        start, stop: distances along that kerb where its edge leaves and meets it, metres.
        edge: (n, 2) its edge, from the kerb around its far end and back to the kerb, metres.
        slot: x, y, yaw of the vehicle that stands in it.
        lanes: width for one lane in and one out, 0 for a driveway without lanes, metres.
        rounding: radius of its corners at the kerb, metres.
    """

    kerb: int
    start: float
    stop: float
    edge: Float[np.ndarray, "n 2"]
    slot: Float[np.ndarray, "3"]
    lanes: float = 0.0
    rounding: float = 0.0


@dataclass
class Site:
    """Streets, kerbs, crossings and traffic elements produced by the layout so far.

    Attributes:
        streets: all of them.
        kerbs: outer edges of the drivable surface; each line has the road on its left and the block on its right.
        islands: closed rings inside the drivable surface (medians, roundabout islands).
        crossings: closed rings of pedestrian crossings.
        elements: traffic lights and signs.
        driveways: gaps in the kerbs that lead to a plot.
        car_parks: (p, 3) x, y, yaw of places in rows on the plots.
        urban: pedestrians walk behind the kerbs, and buildings are close to the road.
    """

    streets: list[Street]
    kerbs: list[Float[np.ndarray, "n 2"]]
    islands: list[Float[np.ndarray, "n 2"]] = field(default_factory=list)
    crossings: list[Float[np.ndarray, "5 2"]] = field(default_factory=list)
    elements: list[MapElement] = field(default_factory=list)
    driveways: list[Driveway] = field(default_factory=list)
    car_parks: Float[np.ndarray, "p 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    urban: bool = True
