"""The connection to the autopilot as an endpoint: all messages from it and to it.

The port sends a heartbeat each second and, while the pilot (`client.pilot`) flies, the desired
velocity, never a position. When the pilot stops, set-points are repeated for half a second only.
Then, and when the process ends, the autopilot's own time-out acts.
"""

from typing import Any

from skytether.client.mavlink import setpoints
from skytether.client.mavlink.autopilot import Autopilot
from skytether.client.mavlink.connection import Connection
from skytether.client.mavlink.hindrances import Hindrances
from skytether.client.mavlink.launch import Phase
from skytether.client.mavlink.setpoints import Sends, Setpoints
from skytether.client.mavlink.streams import HEARTBEAT, request
from skytether.client.positions import Vector
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Datagram, Endpoint, by_name
from skytether.shared.endpoints.line import Line
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason

TICK_NS = 100 * MILLISECOND_NS
"""Interval between two checks for due messages; set-points have their own times [ns]."""
HEARTBEAT_NS = SECOND_NS
CLOSES = 3
"""Number of times that a vehicle in the air is commanded to land when the process ends."""


class Port(Endpoint):
    """Connection to one autopilot; `altitude`: take-off altitude [m]."""

    def __init__(self, scenario: Scenario, vehicle: int, line: Line, altitude: float) -> None:
        super().__init__()
        self._connection = Connection(scenario, vehicle, line, self._events)
        self.autopilot = Autopilot(scenario, vehicle, altitude, self._events)
        self._hindrances = Hindrances(
            scenario,
            vehicle,
            condition=self.autopilot.condition,
            positions=self.autopilot.positions,
            clock=self.autopilot.clock,
            events=self._events,
        )
        self._setpoints = Setpoints(scenario.dt_ns)
        self.now_ns = 0
        self._tick_ns = self._heartbeat_ns = 0

    # -- for the vehicle --------------------------------------------------------------------

    @property
    def is_down(self) -> bool:
        parts = self.autopilot.parts
        return parts is None or parts.launch.is_down(now_ns=self.now_ns)

    def take_off(self, *, may_arm: bool, now_ns: int) -> bool:
        self.now_ns = now_ns
        return self.autopilot.take_off(may_arm=may_arm, now_ns=now_ns)

    def hindrance(self, *, now_ns: int) -> Reason | None:
        self.now_ns = now_ns
        return self._hindrances.reason(self.autopilot.flavour.guided, now_ns=now_ns)

    def fly(self, velocity: Vector) -> None:
        """Send a velocity now, unless a set-point was just sent, and repeat it for a while."""
        self._hindrances.command(velocity, now_ns=self.now_ns)
        if self._setpoints.command(velocity, now_ns=self.now_ns):
            self._send_setpoint()

    def return_home(self) -> None:
        if (parts := self.autopilot.parts) is not None:
            parts.launch.return_home(now_ns=self.now_ns)
            self._tick_ns = self.now_ns

    def land(self) -> None:
        if (parts := self.autopilot.parts) is not None:
            parts.launch.land(now_ns=self.now_ns)
            self._tick_ns = self.now_ns

    # -- received ---------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self.now_ns = now_ns
        autopilot = self.autopilot
        is_quiet, armed = autopilot.is_quiet(now_ns=now_ns), autopilot.condition.armed
        arrivals = self._connection.receive(datagram, is_quiet=is_quiet, armed=armed)
        target = self._connection.target
        if target is None:
            return
        if arrivals.met is not None:
            autopilot.meet(arrivals.met, target)
        if arrivals.moved:
            autopilot.restart()
        for message in arrivals.heard:
            autopilot.hear(message, now_ns=now_ns)
        for message in arrivals.others:
            self._hindrances.rivals.hear(message, target[0], now_ns=now_ns)

    # -- sent -------------------------------------------------------------------------------

    def wake(self, *, now_ns: int) -> None:
        self.now_ns = now_ns
        if now_ns >= self._tick_ns:
            self._tick_ns = now_ns + TICK_NS
            self._send_heartbeats(now_ns)
            self._request_heartbeat()
            for message in self.autopilot.ask(now_ns=now_ns):
                self._say(message)
        setpoint_ns = self._setpoints.due_ns(self._sends(), now_ns=now_ns)
        if setpoint_ns is not None and setpoint_ns <= now_ns:
            self._send_setpoint()

    def next_wake_ns(self) -> int:
        setpoint_ns = self._setpoints.due_ns(self._sends(), now_ns=self.now_ns)
        return self._tick_ns if setpoint_ns is None else min(self._tick_ns, setpoint_ns)

    def _send_heartbeats(self, now_ns: int) -> None:
        if now_ns < self._heartbeat_ns or self._connection.peer is None or self._is_given_up():
            return
        self._heartbeat_ns = now_ns + HEARTBEAT_NS
        self._say(_heartbeat(dialect.MAV_TYPE_ONBOARD_CONTROLLER))
        if self._may_be_station():
            self._say(_heartbeat(dialect.MAV_TYPE_GCS))

    def _request_heartbeat(self) -> None:
        """Request the first heartbeat. Without a request the heartbeat may come a second later, and
        a client that restarts in flight has to send set-points before that.
        """
        if self._connection.unmet is not None:
            peer, target = self._connection.unmet
            wanted = request(target, HEARTBEAT)
            self.send(self._connection.codec.encode(wanted), peer)

    def _is_given_up(self) -> bool:
        """Whether the autopilot is silent during a landing. The client then stops its heartbeats,
        so that the autopilot's own failsafe lands the vehicle.
        """
        parts, condition = self.autopilot.parts, self.autopilot.condition
        lands = parts is not None and parts.launch.phase is Phase.LANDING
        return lands and not condition.is_fresh(now_ns=self.now_ns)

    def _may_be_station(self) -> bool:
        """Whether the client also sends heartbeats of a ground station: PX4 sends its texts to
        ground stations only.

        False if PX4 reacts to the loss of its ground station: if the client acted as one, PX4 would
        no longer notice the loss of the real station.
        """
        parts = self.autopilot.parts
        return (
            parts is not None
            and parts.setup.is_done
            and self.autopilot.flavour.words_for_stations
            and parts.setup.value("NAV_DLL_ACT") == 0.0
        )

    def _sends(self) -> Sends:
        parts, condition = self.autopilot.parts, self.autopilot.condition
        if parts is None:
            return Sends.NOTHING
        if parts.launch.streams_zeros:
            return Sends.ZEROS
        obeys = condition.armed and condition.mode == self.autopilot.flavour.guided
        if parts.launch.phase is Phase.FLYING and obeys and not self._hindrances.bar_setpoints:
            return Sends.COMMANDS
        return Sends.NOTHING

    def _send_setpoint(self) -> None:
        parts, flavour = self.autopilot.parts, self.autopilot.flavour
        if parts is None or self._connection.target is None:
            return
        leaves_ns = None
        if flavour.streams_first:
            leaves_ns = seconds_to_ns(parts.setup.value(flavour.time_out) or 0.0)
        velocity = self._setpoints.take(
            self._sends(),
            leaves_ns=leaves_ns,
            heartbeat_ns=self.autopilot.condition.heartbeat_ns,
            now_ns=self.now_ns,
        )
        if velocity is not None:
            self._say(setpoints.message(self._connection.target, velocity, now_ns=self.now_ns))

    def _say(self, message: Message) -> None:
        if self._connection.peer is not None:
            self.send(self._connection.codec.encode(message), self._connection.peer)

    def close(self, *, now_ns: int) -> None:
        """Command a vehicle in the air to land by itself, if the client controls it."""
        self.now_ns = now_ns
        if (parts := self.autopilot.parts) is not None:
            for message in parts.launch.close(now_ns=now_ns) * CLOSES:
                self._say(message)

    # -- figures -----------------------------------------------------------------------------

    def figures(self) -> dict[str, Any]:
        autopilot, counts, codec = self.autopilot, self._connection.counts, self._connection.codec
        condition, clock, parts = autopilot.condition, autopilot.clock, autopilot.parts
        port_figures: dict[str, Any] = {
            "mode": autopilot.flavour.mode_name(condition.mode),
            "mode_number": condition.mode,
            "armed": int(condition.armed),
            "measurements": autopilot.positions.taken,
            "heard": counts["heard"],
            "setpoints": self._setpoints.count,
            "ignored": {name: counts[name] for name in ("foreign", "for_others")}
            | {"unknown": codec.unknown},
            "dropped": {"elsewhere": counts["elsewhere"], "untimely": autopilot.timesync.untimely}
            | by_name(autopilot.positions.dropped),
            "garbage_bytes": codec.garbage_bytes,
            "drift_ppm": 1e6 * clock.drift,
        }
        if clock.round_trip_ns is not None:
            port_figures["round_trip_ms"] = clock.round_trip_ns / MILLISECOND_NS
        if condition.charge is not None:
            port_figures["battery"] = condition.charge
        if condition.voltage is not None:
            port_figures["voltage_v"] = condition.voltage
        if condition.home is not None:
            names = ("latitude_deg", "longitude_deg", "altitude_m")
            port_figures["home"] = dict(zip(names, condition.home, strict=True))
        if parts is not None and parts.setup.fence:
            port_figures["fence"] = parts.setup.fence
        return port_figures


def _heartbeat(kind: int) -> Message:
    active = dialect.MAV_STATE_ACTIVE
    return dialect.MAVLink_heartbeat_message(kind, dialect.MAV_AUTOPILOT_INVALID, 0, 0, active, 3)
