"""Fixed-time traffic signals, and the states of the map's traffic elements over time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from tflane_jax.scene.logs import MapElement
from tflane_jax.world.roads.networks import RoadNetwork
from tflane_jax.world.roads.traffic_control import GREEN, LIGHT, RED, YELLOW
from tflane_jax.world.traffic.lane_table import LaneTable

# All lights are red for this long between two phases, seconds; drivers who can no longer stop clear the junction.
_CLEARANCE = 3.5
# The phase that was green shows yellow for the first part of that time, seconds.
_YELLOW = 2.5


@dataclass(frozen=True)
class Signals:
    """Fixed-time signals of I intersections.

    Attributes:
        green: (I, P) seconds of green for each phase; 0 where the intersection has fewer phases.
        offset: (I,) time within the cycle at t = 0, seconds.
    """

    green: Float[np.ndarray, "i p"]
    offset: Float[np.ndarray, " i"]

    def green_phase(self, time: float | Float[np.ndarray, "*t"]) -> Int[np.ndarray, "*t i"]:
        """Return which phase is green at each intersection, -1 between phases."""
        phase, left = self._phase(time)
        return np.where(left > _CLEARANCE, phase, -1)

    def shown(self, time: float | Float[np.ndarray, "*t"]) -> Int[np.ndarray, "*t i p"]:
        """Return the light state of each phase at each intersection: red, green, or yellow after green."""
        phase, left = self._phase(time)
        now = np.where(left > _CLEARANCE, GREEN, np.where(left > _CLEARANCE - _YELLOW, YELLOW, RED))
        return np.where(np.arange(self.green.shape[1]) == phase[..., None], now[..., None], RED)

    def _phase(
        self, time: float | Float[np.ndarray, "*t"]
    ) -> tuple[Int[np.ndarray, "*t i"], Float[np.ndarray, "*t i"]]:
        """Return the current phase of each intersection and its remaining time (seconds, clearance included)."""
        slot = np.where(self.green > 0.0, self.green + _CLEARANCE, 0.0)
        ends = np.cumsum(slot, 1)
        at = (np.asarray(time)[..., None] + self.offset) % np.maximum(ends[:, -1], 1e-9)
        phase = (ends <= at[..., None]).sum(-1)
        phase = np.minimum(phase, self.green.shape[1] - 1)
        return phase, ends[np.arange(len(ends)), phase] - at

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
    return replace(signals, offset=offset)


def element_states(network: RoadNetwork, signals: Signals, times: Float[np.ndarray, " f"]) -> Int[np.ndarray, "f e"]:
    """Return the attribute of each map element at each time: a light follows its
    signals, every other element keeps its attribute."""
    state = np.tile(np.array([element.attribute for element in network.map.elements], int), (len(times), 1))
    shown = signals.shown(times)
    for number, element in enumerate(network.map.elements):
        onward = [j for i in element.lanes for j in (i, *network.map.segments[i].successors)]
        governed = [network.signal_phase[j] for j in onward if j in network.signal_phase]
        if element.category == LIGHT and governed:
            state[:, number] = shown[:, governed[0][0], governed[0][1]]
    return state


def show_signals(network: RoadNetwork, state: Int[np.ndarray, " e"]) -> tuple[MapElement, ...]:
    """Return the map's elements with the given attributes."""
    pairs = zip(network.map.elements, state.tolist(), strict=True)
    return tuple(replace(element, attribute=attribute) for element, attribute in pairs)
