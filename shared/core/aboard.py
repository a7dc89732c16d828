"""Events about a vehicle's autopilot: its messages, and the client's judgement of them."""

import msgspec


class VehicleEvent(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    vehicle: int


class AutopilotParameter(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    value: float | None
    """Value; None if the autopilot does not have the parameter."""
    meaning: str
    wanted: str = ""
    """Safe values and the one to set, in words; empty if the value is safe."""

    def __str__(self) -> str:
        value = "missing" if self.value is None else f"{self.value:g}"
        expected = f"; expected {self.wanted}" if self.wanted else ""
        return f"{self.name} = {value}: {self.meaning}{expected}"


class ParametersEvent(VehicleEvent, frozen=True, kw_only=True):
    parameters: tuple[AutopilotParameter, ...]

    def __str__(self) -> str:
        return "\n".join(f"vehicle {self.vehicle}: {parameter}" for parameter in self.parameters)


class AutopilotFound(VehicleEvent, frozen=True, kw_only=True):
    name: str
    system: int

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} has {self.name}, system {self.system}"


class ParametersRead(ParametersEvent, frozen=True, kw_only=True):
    """The client has read the parameters that decide how the autopilot reacts to silence."""


class ParametersSet(VehicleEvent, frozen=True, kw_only=True):
    """The client has set parameters of the autopilot, and read them back."""

    changes: tuple[tuple[str, float, float], ...]

    def __str__(self) -> str:
        lines = [
            f"vehicle {self.vehicle}: {name} is {after:g} from now on, it was {before:g}"
            for name, before, after in self.changes
        ]
        return "\n".join(lines)


class AutopilotRefused(VehicleEvent, frozen=True, kw_only=True):
    asked: str
    answer: str
    """Name of the MAV_RESULT."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: its autopilot refuses to {self.asked}: {self.answer}"


class AutopilotText(VehicleEvent, frozen=True, kw_only=True):
    text: str
    severity: int
    """MAVLink severity, from 0 (emergency) to 7."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}, its autopilot: {self.text}"


class TextsOmitted(VehicleEvent, frozen=True, kw_only=True):
    count: int

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: {self.count} more texts of its autopilot are not logged"


class AutopilotWaits(VehicleEvent, frozen=True, kw_only=True):
    waits_for: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} waits for {self.waits_for}"


class AutopilotElsewhere(VehicleEvent, frozen=True, kw_only=True):
    """Datagrams arrive from another address than that of a silent autopilot, and are dropped."""

    came_from: str
    expected: str
    content: str

    def __str__(self) -> str:
        silent = f"vehicle {self.vehicle}: nothing comes from its autopilot at {self.expected}"
        return f"{silent}; {self.content} from {self.came_from} is dropped"


class AutopilotMoved(VehicleEvent, frozen=True, kw_only=True):
    """The autopilot of a vehicle on the ground has restarted at another address."""

    before: str
    after: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: its autopilot is at {self.after}, it was at {self.before}"


class PositionsDropped(VehicleEvent, frozen=True, kw_only=True):
    why: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: its positions are dropped: {self.why}"


class ClockSilent(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle's autopilot sends messages, but no longer answers TIMESYNC."""

    silent_s: float

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: its autopilot has not answered TIMESYNC for "
            f"{self.silent_s:.0f} s: its time is extrapolated from earlier answers"
        )


class AutopilotMode(VehicleEvent, frozen=True, kw_only=True):
    mode: str
    armed: bool

    def __str__(self) -> str:
        armed = "armed" if self.armed else "disarmed"
        return f"vehicle {self.vehicle}: its autopilot is in {self.mode}, {armed}"


class SecondCommander(VehicleEvent, frozen=True, kw_only=True):
    system: int
    component: int
    said: str
    """Type of the newest message of that sender."""

    def __str__(self) -> str:
        who = f"system {self.system}, component {self.component}"
        return f"vehicle {self.vehicle}: {who} commands its autopilot as well: {self.said}"


class SecondPublisher(VehicleEvent, frozen=True, kw_only=True):
    """Somebody else publishes commands for a robot."""

    topic: str
    nodes: tuple[str, ...]
    """Other nodes of the ROS graph that may publish on the topic; empty if none has told."""

    def __str__(self) -> str:
        who = " or ".join(self.nodes) or "a node without a name"
        return f"vehicle {self.vehicle}: {who} publishes on {self.topic} as well"


class OdometryDropped(VehicleEvent, frozen=True, kw_only=True):
    why: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: messages of its odometry are dropped: {self.why}"


class Strays(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle deviates from its commands by more than wind and model errors explain."""

    off_mps: float
    """Distance of the velocity from the range that the commands explain [m/s]."""

    def __str__(self) -> str:
        off = f"deviates by {self.off_mps:.1f} m/s from its commands"
        return f"vehicle {self.vehicle} {off}: somebody else commands it, or it fails"


class ParametersUnsafe(ParametersEvent, frozen=True, kw_only=True):
    """A vehicle is not armed because its autopilot would react unsafely to silence: parameters are
    unsafe or could not be set.
    """

    sets: bool = False
    """Whether the client was allowed to set the parameters."""

    @property
    def brief(self) -> str:
        unknown = ", ".join(each.name for each in self.parameters if each.value is None)
        unsafe = ", ".join(each.name for each in self.parameters if each.value is not None)
        does = "could not set" if self.sets else "sets"
        problems = [f"{unsafe}; --set-parameters {does} them"] if unsafe else []
        if unknown:
            problems.append(f"its autopilot has not answered about {unknown}, or does not have it")
        return f"vehicle {self.vehicle} is not armed: {'; '.join(problems)}"


class NotTakenOff(VehicleEvent, frozen=True, kw_only=True):
    doing: str
    why: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: {self.doing}: {self.why}"


class ArmingAwaited(VehicleEvent, frozen=True, kw_only=True):
    why: str

    def __str__(self) -> str:
        instruction = "arm it again: skytether set SOCKET armed=true, or on the page"
        return f"vehicle {self.vehicle} is not armed: {self.why}; {instruction}"


class OriginAwaited(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle in the air hovers because the scenario's origin is unknown."""

    place: tuple[float, float, float]
    """Position in the autopilot's local frame: north, east, up [m]."""

    def __str__(self) -> str:
        at = ", ".join(f"{each:.2f}" for each in self.place)
        instruction = (
            "set its origin in that frame: skytether set SOCKET 'mavlink.origin=[N, E, UP]'"
        )
        return (
            f"vehicle {self.vehicle} hovers at [{at}] of its autopilot's local frame "
            f"(north, east, up), and its origin is not known; {instruction}"
        )


AboardFailure = ParametersUnsafe | NotTakenOff
AboardEvent = (
    AutopilotFound
    | ParametersRead
    | ParametersSet
    | AutopilotRefused
    | AutopilotText
    | TextsOmitted
    | AutopilotWaits
    | AutopilotElsewhere
    | AutopilotMoved
    | PositionsDropped
    | ClockSilent
    | AutopilotMode
    | ArmingAwaited
    | OriginAwaited
    | SecondCommander
    | SecondPublisher
    | OdometryDropped
    | Strays
    | AboardFailure
)
