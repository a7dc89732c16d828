"""Take-off and landing: mode, arming, climb and descent, all done by the autopilot.

    GROUND → CLIMBING (the steps of its flavour, one after another) → FLYING → LANDING → down

A step is done when the autopilot's state shows it; until then the step's command is repeated. A
vehicle is armed only on the ground and only if `armed` is set in the scenario. A mode chosen by
somebody else is not changed: once the vehicle is armed, the client replaces only a mode that it has
set, or to which its take-off command led. A pilot returns control to the client by choosing the
mode that follows set-points.

A vehicle that an earlier run of the client, or somebody else, has armed is not armed again before
an operator allows arming: a process restarted after a landing must not make the vehicle take off. A
vehicle in the air whose origin is unknown hovers until an operator gives the origin.
"""

from enum import Enum, auto

from skytether.client.mavlink.condition import FRESH_NS as HEARTBEAT_MAX_NS
from skytether.client.mavlink.condition import Condition
from skytether.client.mavlink.flavours import Flavour, LaunchStep
from skytether.client.positions import Positions
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Events
from skytether.shared.events.aboard import (
    ArmingAwaited,
    AutopilotRefused,
    NotTakenOff,
    OriginAwaited,
)

AGAIN_NS = SECOND_NS
STREAM_NS = 500 * MILLISECOND_NS
"""Time for which set-points are sent before requesting a mode that needs them."""
FRESH_NS = 500 * MILLISECOND_NS
"""Age up to which a position counts as current."""
LAND_MAX_NS = 120 * SECOND_NS
RETURN_MAX_NS = 600 * SECOND_NS
REFUSED_NS = 4 * SECOND_NS
"""Time for which a vehicle may ignore the command to return before it is commanded to land [ns]."""
QUIET_NS = 3 * SECOND_NS
"""Silence of the autopilot after which the log gives it as the reason for an unfinished step."""
SILENT_MAX_NS = 10 * SECOND_NS
"""Silence of the autopilot after which the client stops waiting for the end of a landing."""
THERE_M = 0.3
"""Distance below the take-off altitude within which the climb may count as over [m]."""
LIFTED_M = 1.0
"""Distance below the take-off altitude from which the autopilot may end the climb by itself: PX4
ends it at NAV_MC_ALT_RAD, by default 0.8 m."""
STILL_MPS = 0.3
"""Vertical speed below which the climb may count as over [m/s]."""
SET_MODE = int(dialect.MAV_CMD_DO_SET_MODE)
ARM = int(dialect.MAV_CMD_COMPONENT_ARM_DISARM)
TAKE_OFF = int(dialect.MAV_CMD_NAV_TAKEOFF)
ACCEPTED, IN_PROGRESS = int(dialect.MAV_RESULT_ACCEPTED), int(dialect.MAV_RESULT_IN_PROGRESS)
RESULTS = {
    number: entry.name.removeprefix("MAV_RESULT_").replace("_", " ").lower()
    for number, entry in dialect.enums["MAV_RESULT"].items()
}
SILENT = "it is silent"
WORDS = {SET_MODE: "change its mode", ARM: "arm", TAKE_OFF: "take off"}
NOT_DONE = {
    LaunchStep.HOLD: "not in a mode that holds",
    LaunchStep.GUIDE: "not in the mode that follows set-points",
    LaunchStep.ARM: "not armed",
    LaunchStep.LIFT: "not taken off",
    LaunchStep.CLIMB: "not at the altitude of take-off",
}


class Phase(Enum):
    GROUND = auto()
    CLIMBING = auto()
    FLYING = auto()
    LANDING = auto()


class Launch:
    """Take-off and landing of one vehicle.

    Args:
        target: numbers of the autopilot's system and component.
        altitude: take-off altitude above the ground [m].
        patience_ns: time that each step may take [ns].
        from_takeoff: whether the scenario's origin is the place of arming.
    """

    def __init__(
        self,
        vehicle: int,
        flavour: Flavour,
        target: tuple[int, int],
        *,
        altitude: float,
        patience_ns: int,
        from_takeoff: bool,
        condition: Condition,
        positions: Positions,
        events: Events,
    ) -> None:
        self._vehicle, self._flavour, self._target = vehicle, flavour, target
        self._altitude, self._patience_ns = altitude, patience_ns
        self._from_takeoff = from_takeoff
        self._condition, self._positions, self._events = condition, positions, events
        self.phase = Phase.GROUND
        self._step = 0
        self._since_ns: int | None = None
        self._asked_ns: int | None = None
        """Time at which the command of the present step was last sent [ns]."""
        self._accepted = False
        self._own_mode: int | None = None
        """Number of the mode, other than the guided one, that the client has set; None in flight,
        or after somebody else has changed the mode."""
        self._lift_asked = False
        self.why_not_armed = ""
        """Why an operator has to allow arming; empty if arming needs no permission."""
        self._asked_to_arm = False
        self._hovers_ns: int | None = None
        """Time since which the vehicle hovers because the origin is unknown; None if it does not
        hover."""
        self.took_off = False
        self._closed = False
        """Whether take-off is no longer allowed, because the process ends."""
        self._landing_mode = flavour.land
        self.waits_for = ""
        """Reason why the vehicle cannot take off yet, in words; empty if there is none."""
        self._stated_reason = ""
        """Reason that the autopilot gave for a refusal in the present step of the launch."""
        self._refused: set[tuple[int, int]] = set()
        """Refusals reported in the present step of the launch: command and result."""
        self.failure: NotTakenOff | None = None

    # -- take-off --------------------------------------------------------------------------

    def take_off(self, *, may_arm: bool, now_ns: int) -> bool:
        """Continue the take-off; returns whether the vehicle can be flown.

        `may_arm` allows arming a vehicle on the ground.
        """
        if self._is_flying and not self.failure:
            is_placed = self._is_placed(now_ns)
            if not is_placed:
                self._wait("not flown", "its position is unknown", now_ns)
            return is_placed
        if self.failure or self._closed or self.phase is Phase.LANDING:
            return False
        if self.phase is Phase.GROUND:
            self._begin(may_arm, now_ns)
        if self.phase is Phase.CLIMBING:
            self._climb(now_ns)
        return self._is_flying

    @property
    def _is_flying(self) -> bool:
        return self.phase is Phase.FLYING

    def _is_placed(self, now_ns: int) -> bool:
        came_ns = self._positions.came_ns
        return came_ns is not None and now_ns - came_ns <= FRESH_NS

    def _begin(self, may_arm: bool, now_ns: int) -> None:
        """Begin the climb when possible; take over a vehicle that is already in the air."""
        condition, flavour = self._condition, self._flavour
        mode, guided = flavour.mode_name(condition.mode), flavour.mode_name(flavour.guided)
        if self._silence(now_ns):
            self._wait("not ready", SILENT, now_ns)
        elif not condition.is_fresh(now_ns=now_ns) or not condition.landed:
            self._wait("not ready", "it does not report whether it is on the ground", now_ns)
        elif not self._is_placed(now_ns):
            self._wait("not ready", "its position is unknown", now_ns)
        elif condition.is_flying and condition.mode == flavour.guided:
            self._go_on(now_ns)
        elif condition.armed and condition.is_airborne:
            self.why_not_armed = "it was in the air when this client began"
            expected = f"expected it on the ground, or in {guided}"
            self._wait("not flown", f"it is in the air in {mode}; {expected}", now_ns)
        elif condition.armed and condition.mode != flavour.guided:
            self.why_not_armed = self.why_not_armed or "it was armed by somebody else"
            expected = f"expected it disarmed, or in {guided}"
            self._wait("not flown", f"it is armed, in {mode}; {expected}", now_ns)
        elif may_arm and condition.battery_is_weak:
            self._wait("not armed", "its battery is low, see mavlink.battery_min", now_ns)
        elif may_arm and self.why_not_armed:
            self._ask_to_arm()
        elif may_arm:
            self.took_off = True
            self._enter(Phase.CLIMBING, now_ns)
        else:
            self._since_ns, self.waits_for = None, "armed = true"

    def _go_on(self, now_ns: int) -> None:
        """Fly a vehicle that is already in the air, or let it hover until its origin is known."""
        if self._positions.has_origin:
            self._hovers_ns = None
            self._enter(Phase.FLYING, now_ns)
        elif self._hovers_ns is None:
            self._hovers_ns = now_ns
            place = self._positions.position
            assert place is not None
            self._events.append(OriginAwaited(vehicle=self._vehicle, place=place))
        elif now_ns - self._hovers_ns > self._patience_ns:
            waited = f"not flown in {self._patience_ns / SECOND_NS:g} s"
            self._enter(Phase.FLYING, now_ns)  # `_fail` lands a vehicle only in this phase
            self._fail(waited, "its origin is unknown, see mavlink.origin", now_ns)

    def _ask_to_arm(self) -> None:
        self._since_ns, self.waits_for = None, "armed = true"
        if not self._asked_to_arm:
            self._asked_to_arm = True
            self._events.append(ArmingAwaited(vehicle=self._vehicle, why=self.why_not_armed))

    def arm(self) -> None:
        """Allow arming, on an operator's order; no effect unless the vehicle is on the ground."""
        condition = self._condition
        if self.phase is Phase.GROUND and not (condition.armed or condition.is_airborne):
            self.why_not_armed, self._asked_to_arm = "", False

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self.phase, self.waits_for = phase, ""
        if phase is not Phase.LANDING:
            self._own_mode, self._lift_asked = None, False
        self._begin_step(0, now_ns)

    def _begin_step(self, step: int, now_ns: int) -> None:
        self._step, self._since_ns, self._asked_ns = step, now_ns, None
        self._stated_reason = ""
        self._refused.clear()

    def _climb(self, now_ns: int) -> None:
        condition, steps = self._condition, self._flavour.steps
        while self._step < len(steps):
            armed_before = steps.index(LaunchStep.ARM) < self._step
            if armed_before and not condition.armed:
                self._fail("not taken off", self._stated_reason or "it was disarmed", now_ns)
                return
            is_own = self._has_own_mode(now_ns)
            if (self._step > 0 or condition.armed) and not is_own:
                mode = self._flavour.mode_name(condition.mode)
                self._fail("not taken off", f"it was taken over: it is in {mode}", now_ns)
                return
            step = steps[self._step]
            if not self._is_done(step):
                at = f"it is at {self._positions.altitude:.1f} m"
                self._wait(NOT_DONE[step], at if step is LaunchStep.CLIMB else "no answer", now_ns)
                return
            if step is LaunchStep.ARM and self._from_takeoff:
                self._positions.begin()
            self._begin_step(self._step + 1, now_ns)
        self._enter(Phase.FLYING, now_ns)

    def _is_done(self, step: LaunchStep) -> bool:
        condition = self._condition
        match step:
            case LaunchStep.HOLD:
                return condition.mode == self._flavour.hold
            case LaunchStep.GUIDE:
                return condition.mode == self._flavour.guided
            case LaunchStep.ARM:
                return condition.armed
            case LaunchStep.LIFT:
                return self._accepted or condition.is_airborne
            case LaunchStep.CLIMB:
                at_altitude = self._positions.altitude >= self._altitude - THERE_M
                return at_altitude and abs(self._positions.velocity[2]) < STILL_MPS

    def _wait(self, doing: str, why: str, now_ns: int) -> None:
        """Wait until the autopilot has done a step; give up after too long."""
        if self._since_ns is None:
            self._since_ns = now_ns
        if self.phase is Phase.GROUND:
            self.waits_for = f"its autopilot, {doing}: {why}"
        else:
            self.waits_for = f"its autopilot, {doing}: {SILENT}" if self._silence(now_ns) else ""
        if now_ns - self._since_ns > self._patience_ns:
            waited = f"{doing} in {self._patience_ns / SECOND_NS:g} s"
            self._fail(waited, self._silence(now_ns) or self._stated_reason or why, now_ns)

    def _silence(self, now_ns: int) -> str:
        """Message about a silent autopilot; empty if it is not silent."""
        heard_ns = self._condition.heard_ns
        if heard_ns is None or now_ns - heard_ns <= QUIET_NS:
            return ""
        return f"no message from its autopilot for {(now_ns - heard_ns) / SECOND_NS:.0f} s"

    def _fail(self, doing: str, why: str, now_ns: int) -> None:
        self.failure = NotTakenOff(vehicle=self._vehicle, doing=doing, why=why)
        self._events.append(self.failure)
        self.land(now_ns=now_ns)

    @property
    def streams_zeros(self) -> bool:
        """Whether a stream of zero set-points has to be sent, because the next mode needs the
        stream or because the vehicle hovers.
        """
        if self.phase is Phase.GROUND and self._hovers_ns is not None:
            return self._condition.mode == self._flavour.guided
        if self.phase is not Phase.CLIMBING or not self._flavour.streams_first:
            return False
        return self._flavour.steps[self._step] is LaunchStep.GUIDE

    # -- landing ----------------------------------------------------------------------------

    def return_home(self, *, now_ns: int) -> None:
        """Return home and land there, if the client controls the vehicle and it is in the air."""
        if self.phase in (Phase.CLIMBING, Phase.FLYING):
            self._landing_mode = self._flavour.back
        self.land(now_ns=now_ns)

    def land(self, *, now_ns: int) -> None:
        """Land, if the client controls the vehicle and it is in the air."""
        if self.phase in (Phase.CLIMBING, Phase.FLYING):
            self._enter(Phase.LANDING, now_ns)

    def close(self, *, now_ns: int) -> list[Message]:
        """End the launch; returns messages that land the vehicle if the client controls it."""
        self._closed = True
        if self.phase is Phase.GROUND or not self._is_ours(now_ns):
            return []
        return [self._mode_command(self._flavour.land)]

    def _is_ours(self, now_ns: int) -> bool:
        """Whether a current heartbeat shows the vehicle armed and in a mode of the client."""
        condition = self._condition
        return self._has_own_mode(now_ns) and condition.armed and condition.is_fresh(now_ns=now_ns)

    def _has_own_mode(self, now_ns: int) -> bool:
        """Whether the vehicle is in the guided mode, in a mode that the client has set, or in one
        to which the client's take-off command led.
        """
        mode, flavour = self._condition.mode, self._flavour
        is_high = self._positions.altitude >= self._altitude - LIFTED_M
        if self._holds_first(mode):
            self._own_mode = mode
        elif self._own_mode == flavour.hold and self._lift_asked and not is_high:
            # Until the next heartbeat arrives, the known mode is the mode before the command.
            if mode == flavour.lift or self._is_late_to_lift(now_ns):
                self._own_mode = flavour.lift
        elif self._own_mode == flavour.lift and is_high and mode == flavour.hold:
            self._own_mode = mode
        if mode in (self._own_mode, flavour.guided):
            return True
        self._own_mode = None
        return False

    def _holds_first(self, mode: int) -> bool:
        """Whether the client has set the mode that the first step waits for."""
        if self.phase is not Phase.CLIMBING or mode != self._flavour.hold:
            return False
        is_asked = self._asked_ns is not None or not self._condition.armed
        return is_asked and self._flavour.steps[self._step] is LaunchStep.HOLD

    def _is_late_to_lift(self, now_ns: int) -> bool:
        """Whether the mode to which an accepted take-off command leads has not appeared in time."""
        climbs = self.phase is Phase.CLIMBING and self._accepted
        if not climbs or self._flavour.steps[self._step] is not LaunchStep.CLIMB:
            return False
        assert self._since_ns is not None
        return now_ns - self._since_ns > HEARTBEAT_MAX_NS

    def is_down(self, *, now_ns: int) -> bool:
        """Whether the vehicle is on the ground, or no longer under the client's control."""
        condition = self._condition
        if self.phase is Phase.GROUND or not condition.armed:
            return True
        if self.phase is not Phase.LANDING:
            return False
        assert self._since_ns is not None
        lost = condition.heard_ns is None or now_ns - condition.heard_ns > SILENT_MAX_NS
        lands = condition.mode in (self._flavour.land, self._landing_mode)
        obeys = lands or self._has_own_mode(now_ns)
        most_ns = LAND_MAX_NS if self._landing_mode == self._flavour.land else RETURN_MAX_NS
        return lost or not obeys or now_ns - self._since_ns > most_ns

    # -- commands and their answers ---------------------------------------------------------

    def ask(self, *, now_ns: int) -> list[Message]:
        if self._asked_ns is not None and now_ns - self._asked_ns < AGAIN_NS:
            return []
        command = self._command(now_ns)
        if command is None:
            return []
        self._asked_ns = now_ns
        return [command]

    def _command(self, now_ns: int) -> Message | None:
        if self.phase is Phase.LANDING:
            return self._come_down(now_ns) if self._is_ours(now_ns) else None
        if self.phase is not Phase.CLIMBING or self._closed:
            return None
        step = self._flavour.steps[self._step]
        if step is LaunchStep.GUIDE and self._flavour.streams_first:
            assert self._since_ns is not None
            if now_ns - self._since_ns < STREAM_NS:
                return None
        modes = {LaunchStep.HOLD: self._flavour.hold, LaunchStep.GUIDE: self._flavour.guided}
        if step in modes:
            return self._mode_command(modes[step])
        if step is LaunchStep.ARM:
            return self._long(ARM, 1.0)
        return self._lift() if step is LaunchStep.LIFT else None

    def _come_down(self, now_ns: int) -> Message:
        """Command to land or to return; after an ignored command to return, the command to land."""
        assert self._since_ns is not None
        if now_ns - self._since_ns > REFUSED_NS:
            self._landing_mode = self._flavour.land
        return self._mode_command(self._landing_mode)

    def _lift(self) -> Message | None:
        altitude = self._altitude
        if self._flavour.above_sea:
            if self._condition.home is None:
                self._stated_reason = "its autopilot reports no home position"
                return None
            # The altitude of the ground in the estimate has drifted since home was set.
            ground = self._positions.origin[2] - self._condition.home_up
            altitude += self._condition.home[2] + ground
        self._lift_asked = True
        nan = float("nan")
        return self._long(TAKE_OFF, 0.0, 0.0, 0.0, nan, nan, nan, altitude)

    def _mode_command(self, mode: int) -> Message:
        return self._long(SET_MODE, *self._flavour.mode_parts(mode))

    def _long(self, command: int, *parameters: float) -> Message:
        padded = (*parameters, *(0.0,) * (7 - len(parameters)))
        return dialect.MAVLink_command_long_message(*self._target, command, 0, *padded)

    def hear(self, message: Message) -> None:
        command, result = message.command, message.result
        if command not in WORDS or result == IN_PROGRESS:
            return
        if result == ACCEPTED:
            climbing = self.phase is Phase.CLIMBING
            if (
                command == TAKE_OFF
                and climbing
                and self._flavour.steps[self._step] is LaunchStep.LIFT
            ):
                self._accepted = True
            return
        answer = RESULTS.get(result, f"result {result}")
        if (command, result) not in self._refused:
            self._refused.add((command, result))
            command_text = WORDS[command]
            self._events.append(
                AutopilotRefused(vehicle=self._vehicle, asked=command_text, answer=answer)
            )
        self._stated_reason = self._stated_reason or answer

    def hear_text(self, text: str) -> None:
        self._stated_reason = text
