"""Rolling out the traffic in time: entering, driving and leaving vehicles, crossing pedestrians."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from tflane_jax.world.traffic.demand import Trips
from tflane_jax.world.traffic.driving import Convoy, acceleration, crossings_busy, footing
from tflane_jax.world.traffic.lane_table import COMFORTABLE_BRAKING, LaneTable
from tflane_jax.world.traffic.pedestrians import Crossers, CrossingPlaces
from tflane_jax.world.traffic.signals import Signals

# Vehicles start this far outside the map and drive on this far beyond it, metres.
_BEYOND = 40.0
# Vehicles present at the start have driven at this fraction of their desired speed.
_PACE = 0.45
# The ego vehicle replaces a vehicle within the first distance; else vehicles nearer than the second are removed,
# metres. Traffic counts as flowing above the third value, m/s.
_TAKES_PLACE, _CLEARED, _FLOWING = 25.0, 12.0, 3.5
# The set of active vehicles is updated at this interval, seconds.
_ROLL_CALL = 1.2


class Rollout:
    """State of the simulation: positions and speeds of all trips, and the crossing pedestrians.

    Attributes:
        position: (N,) distance of each vehicle's middle along its route, metres; -inf before it enters, inf after.
        speed: (N,) m/s.
        active: (N,) is simulated.
    """

    def __init__(
        self,
        table: LaneTable,
        signals: Signals,
        trips: Trips,
        crossers: Crossers,
        places: CrossingPlaces,
        crossings: int,
    ):
        self.table, self.signals, self.trips = table, signals, trips
        self.crossers, self.places, self.crossings = crossers, places, crossings
        count = len(trips.enters)
        self.position = np.full(count, -np.inf)
        self.speed = np.zeros(count)
        self.active = np.zeros(count, bool)

    def place_early_trips(self, time: float) -> None:
        """Place the trips that entered before `time` at the positions of an undisturbed drive, without overlaps."""
        trips, routes = self.trips, self.trips.routes
        early = np.flatnonzero(trips.enters < time)
        entry = routes.segment[early, 0]
        wanted = np.minimum(
            self.table.speed_at_start[entry] * trips.drivers.eagerness[early], trips.drivers.top_speed[early]
        )
        at = (time - trips.enters[early]) * _PACE * wanted
        segment, station = routes.take(early).place(at)
        speed = np.minimum(wanted, self.table.speed[self.table.vertex(segment, station)])
        xy, _ = self.table.locate(segment, station)
        room = 0.5 * trips.drivers.size[early, 0] + 1.5
        near = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) < room[:, None] + room
        # Of two overlapping vehicles the one with the larger index is dropped, and so are vehicles inside junctions.
        keep = (at < routes.length[early]) & ~np.tril(near, -1).any(1) & ~self.table.is_gate[segment]
        self.position[early] = np.where(keep, at, np.inf)
        self.speed[early] = speed
        self.active[early] = keep

    def drive(
        self, start: float, dt: float, steps: int, substeps: int
    ) -> tuple[Float[np.ndarray, "t n"], Float[np.ndarray, "t p"]]:
        """Advance by `steps` steps; return positions and the pedestrians' progress at every substep."""
        positions, progress = [], []
        roll_call = max(1, int(_ROLL_CALL / dt))
        for first in range(0, steps, roll_call):
            count = min(roll_call, steps - first)
            moved, walked = self._drive_together(start + first * dt, dt, count, substeps)
            positions += moved
            progress += walked
        shape = (len(positions), len(self.position))
        return np.array(positions).reshape(shape), np.array(progress).reshape(shape[0], len(self.crossers.pace))

    def _drive_together(
        self, start: float, dt: float, steps: int, substeps: int
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Advance with an unchanging set of vehicles."""
        self._let_in(start)
        rows = np.flatnonzero(self.active)
        drivers = self.trips.drivers
        convoy = Convoy(
            self.trips.routes.take(rows),
            0.5 * drivers.size[rows, 0],
            drivers.eagerness[rows],
            drivers.top_speed[rows],
            drivers.acceleration[rows],
            drivers.headway[rows],
            self.position[rows],
            self.speed[rows],
        )
        positions, progress = [], []
        tau = np.arange(substeps) * (dt / substeps)
        for step in range(steps):
            at = footing(convoy)
            red = self.signals.red(self.table, start + step * dt)
            over = self.crossers.in_the_way(self.places)
            walked_over = self.places.segment[over], self.places.station[over]
            chosen = acceleration(convoy, at, self.table, red, walked_over)
            busy = crossings_busy(convoy, at, self.places, self.crossings)
            speed = np.maximum(convoy.speed + chosen * dt, 0.0)
            # A vehicle that stops within the step brakes evenly until the end of the step.
            chosen = (speed - convoy.speed) / dt
            now = convoy.position + convoy.speed * tau[:, None] + 0.5 * chosen * tau[:, None] ** 2
            for k in range(substeps):
                everyone = self.position.copy()
                everyone[rows] = now[k]
                positions.append(everyone)
                progress.append(self.crossers.progress)
                self.crossers.advance(dt / substeps, busy)
            convoy.position = convoy.position + 0.5 * (convoy.speed + speed) * dt
            convoy.speed = speed
        self.position[rows], self.speed[rows] = convoy.position, convoy.speed
        gone = rows[convoy.position > convoy.routes.length + _BEYOND]
        self.position[gone], self.active[gone] = np.inf, False
        return positions, progress

    def _let_in(self, time: float) -> None:
        """Start the trips whose vehicle has come within `_BEYOND` of the map."""
        entry = self.trips.routes.segment[:, 0]
        speed = np.minimum(
            self.table.speed_at_start[entry] * self.trips.drivers.eagerness, self.trips.drivers.top_speed
        )
        at = (time - self.trips.enters) * speed
        comes = (self.position == -np.inf) & (at > -_BEYOND)
        self.position[comes], self.speed[comes], self.active[comes] = at[comes], speed[comes], True

    def put_ego(self, starts: Float[np.ndarray, " c"]) -> None:
        """Place the ego vehicle on its route where traffic flows, instead of a vehicle that is there.

        Args:
            starts: candidate distances along its route; the first one in flowing traffic is taken, else the first one.
        """
        rows = np.flatnonzero(self.active)
        routes, table = self.trips.routes, self.table
        segment, station = routes.take(np.zeros(len(starts), np.intp)).place(starts)
        segments, stations = routes.take(rows).place(self.position[rows])
        gap = np.where(segments == segment[:, None], np.abs(stations - station[:, None]), np.inf)
        taken = gap.min(1, initial=np.inf) < _TAKES_PLACE
        other = gap.argmin(1) if len(rows) else np.zeros(len(starts), np.intp)
        flows = np.ones(len(starts), bool)
        flows[taken] = self.speed[rows[other[taken]]] > _FLOWING
        choice = int(flows.argmax())
        at, lane = starts[choice], segment[choice]
        if taken[choice]:
            speed = self.speed[rows[other[choice]]]
            at = at + stations[other[choice]] - station[choice]
            self._remove(rows[[other[choice]]])
        else:
            xy, _ = table.locate(segments, stations)
            own, _ = table.locate(lane, station[choice])
            self._remove(rows[np.hypot(*(xy - own).T) < _CLEARED])
            ahead = np.where(table.is_gate[routes.segment[0]], routes.start[0] - at - 4.0, -1.0)
            to_gate = ahead[ahead > 0.0].min(initial=np.inf)
            here = table.speed[table.vertex(lane, station[choice])]
            speed = min(here, self.trips.drivers.top_speed[0], np.sqrt(2.0 * COMFORTABLE_BRAKING * to_gate))
        self.position[0], self.speed[0], self.active[0] = at, speed, True

    def _remove(self, rows: Int[np.ndarray, " k"]) -> None:
        self.position[rows], self.active[rows] = np.inf, False
