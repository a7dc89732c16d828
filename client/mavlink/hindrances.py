"""Reasons on the vehicle's side that forbid following a plan, in order of precedence.

disarmed → another mode → second commander → bad estimate → low battery → silence
"""

from skytether.client.clock import BootClock
from skytether.client.mavlink.condition import Condition
from skytether.client.mavlink.keys import MavlinkConfig
from skytether.client.mavlink.obedience import Obedience
from skytether.client.mavlink.rivals import Rivals
from skytether.client.mavlink.texts import SAME_TEXT_NS
from skytether.client.positions import Positions, Vector
from skytether.shared.base.units import MILLISECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Events
from skytether.shared.events.aboard import PositionsDropped, SecondCommander, Strays
from skytether.shared.events.flight import VehicleEvent
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Reason

FRESH_NS = 200 * MILLISECOND_NS
"""Largest age of a velocity that is compared with the command."""


class Hindrances:
    """Watches one autopilot in flight for reasons not to follow a plan."""

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int,
        *,
        condition: Condition,
        positions: Positions,
        clock: BootClock,
        events: Events,
    ) -> None:
        keys = scenario.section(MavlinkConfig)
        self._silence_ns = seconds_to_ns(keys.silence_s)
        self._yields_to_others = keys.second_commander == "yield"
        self._vehicle, self._condition, self._positions = vehicle, condition, positions
        self._clock, self._events = clock, events
        self.rivals, self._obedience = Rivals(), Obedience(scenario)
        self._yields = False
        """Whether a second commander flies the vehicle, so that the client sends no set-points."""
        self._is_taken = False
        """Whether somebody else flies the vehicle, or landed it and has not taken off again."""
        self._was_disarmed = False
        """Whether the vehicle was disarmed since it flew, so that it is not flown again."""
        self._reported_ns: dict[Reason, int] = {}
        """Time at which a second commander was last reported, by kind of detection."""
        self._reported_unusable = False

    @property
    def bar_setpoints(self) -> bool:
        """Whether no set-point may be sent: the vehicle was disarmed, or somebody else flies it."""
        return self._was_disarmed or self._yields or self._is_taken

    def command(self, velocity: Vector, *, now_ns: int) -> None:
        """Compare the vehicle's velocity with its commands, and command `velocity` from now on:
        north, east and up [m/s].
        """
        came_ns = self._positions.came_ns
        if came_ns is not None and now_ns - came_ns <= FRESH_NS:
            self._obedience.step(velocity, self._positions.velocity, now_ns=now_ns)
        else:
            self._obedience.pause()

    def reason(self, guided: int, *, now_ns: int) -> Reason | None:
        """Reason that forbids following a plan now; `guided`: number of the mode that follows
        set-points.
        """
        condition = self._condition
        if not condition.armed or self._was_disarmed:
            self._was_disarmed = True
            return Reason.DISARMED
        self._yields = False
        self._is_taken = condition.mode != guided or (self._is_taken and condition.is_on_ground)
        if self._is_taken:
            self._obedience.begin()
            return Reason.TAKEN
        if rival := self._rival(now_ns):
            self._yields = self._yields_to_others
            return Reason.TAKEN if self._yields else rival
        if condition.is_astray(now_ns=now_ns):
            return Reason.ASTRAY
        if condition.battery_is_low(now_ns=now_ns):
            return Reason.BATTERY
        return self._silence(now_ns)

    def _rival(self, now_ns: int) -> Reason | None:
        """Reason for a second commander, by how it was detected; None if none was detected."""
        event: VehicleEvent
        if self.rivals.are_there(now_ns=now_ns):
            system, component, content = self.rivals.newest
            cause = Reason.RIVAL
            event = SecondCommander(
                vehicle=self._vehicle, system=system, component=component, said=content
            )
        elif self._obedience.strays:
            cause = Reason.STRAYED
            event = Strays(vehicle=self._vehicle, off_mps=self._obedience.off_mps)
        else:
            return None
        if now_ns - self._reported_ns.get(cause, -SAME_TEXT_NS) >= SAME_TEXT_NS:
            self._reported_ns[cause] = now_ns
            self._events.append(event)
        return cause

    def _silence(self, now_ns: int) -> Reason | None:
        """Reason if the autopilot is silent, or its positions are unusable; None otherwise."""
        if not self._is_past(self._positions.came_ns, now_ns):
            self._reported_unusable = False
            return None if self._condition.is_fresh(now_ns=now_ns) else Reason.MUTE
        if self._is_past(self._positions.heard_ns, now_ns):
            return Reason.MUTE
        self._report_unusable()
        return Reason.UNUSABLE

    def _is_past(self, came_ns: int | None, now_ns: int) -> bool:
        return came_ns is None or now_ns - came_ns > self._silence_ns

    def _report_unusable(self) -> None:
        why = self._positions.fault
        if self._reported_unusable or not why:
            return
        self._reported_unusable = True
        if fault := self._clock.rate_fault:
            why += f", and the speed of its clock is {fault}"
        self._events.append(PositionsDropped(vehicle=self._vehicle, why=why))
