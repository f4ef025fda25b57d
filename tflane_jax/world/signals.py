"""Traffic lights over time, and the state that the map's elements show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.logs import MapElement
from tflane_jax.world.lane_table import LaneTable
from tflane_jax.world.roads import RoadNetwork
from tflane_jax.world.traffic_control import GREEN, LIGHT, RED

# All lights are red for this long between two phases, seconds; drivers who can no longer stop clear the junction.
_CLEARANCE = 3.5


@dataclass(frozen=True)
class Signals:
    """Fixed-time signals of I intersections.

    Attributes:
        green: (I, P) seconds of green for each phase; 0 where the intersection has fewer phases.
        offset: (I,) time within the cycle at t = 0, seconds.
    """

    green: Float[np.ndarray, "i p"]
    offset: Float[np.ndarray, " i"]

    def green_phase(self, time: float) -> Int[np.ndarray, " i"]:
        """Return which phase is green at each intersection, -1 between phases."""
        slot = np.where(self.green > 0.0, self.green + _CLEARANCE, 0.0)
        ends = np.cumsum(slot, 1)
        at = (time + self.offset) % np.maximum(ends[:, -1], 1e-9)
        phase = (ends <= at[:, None]).sum(1)
        phase = np.minimum(phase, self.green.shape[1] - 1)
        row = np.arange(len(phase))
        left = ends[row, phase] - at
        return np.where(left > _CLEARANCE, phase, -1)

    def red(self, table: LaneTable, time: float) -> Bool[np.ndarray, " s"]:
        """Return the segments that must not be entered now."""
        governed = table.intersection >= 0
        red = np.zeros(len(governed), bool)
        if len(self.offset):
            red[governed] = self.green_phase(time)[table.intersection[governed]] != table.phase[governed]
        return red


def draw_signals(rng: np.random.Generator, table: LaneTable) -> Signals:
    """Draw green times of 9 to 16 seconds and the moment of the cycle at t = 0."""
    intersections, phases = table.intersection.max(initial=-1) + 1, table.phase.max(initial=-1) + 1
    used = np.zeros((intersections, max(phases, 1)), bool)
    governed = table.intersection >= 0
    used[table.intersection[governed], table.phase[governed]] = True
    green = np.where(used, rng.uniform(9.0, 16.0, used.shape), 0.0)
    cycle = (green + _CLEARANCE * used).sum(1)
    return Signals(green, rng.random(intersections) * cycle)


def turn_green(signals: Signals, intersection: int, phase: int, time: float) -> Signals:
    """Return the signals shifted so that a phase of one intersection becomes green at `time`."""
    before = (signals.green[intersection, :phase] + _CLEARANCE * (signals.green[intersection, :phase] > 0.0)).sum()
    offset = signals.offset.copy()
    offset[intersection] = before - time
    return Signals(signals.green, offset)


def show_signals(network: RoadNetwork, signals: Signals, time: float) -> tuple[MapElement, ...]:
    """Return the map's elements with each light green or red as the signals are at `time`."""
    green = signals.green_phase(time)

    def state(element: MapElement) -> MapElement:
        onward = [j for i in element.lanes for j in (i, *network.map.segments[i].successors)]
        governed = [network.signal_phase[j] for j in onward if j in network.signal_phase]
        if element.category != LIGHT or not governed:
            return element
        intersection, phase = governed[0]
        return replace(element, attribute=GREEN if green[intersection] == phase else RED)

    return tuple(state(element) for element in network.map.elements)
