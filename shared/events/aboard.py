"""Events about a vehicle's autopilot: its messages, and the client's judgement of them."""

import msgspec

from skytether.shared.events.flight import Event, Failure, VehicleEvent


class AutopilotParameter(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    value: float | None
    """Value of the parameter; None if the autopilot does not have it."""
    meaning: str
    wanted: str = ""
    """Safe values, and the value to set, in words; empty if the present value is safe."""

    def __str__(self) -> str:
        value = "missing" if self.value is None else f"{self.value:g}"
        expected = f"; expected {self.wanted}" if self.wanted else ""
        return f"{self.name} = {value}: {self.meaning}{expected}"


class ParametersEvent(VehicleEvent):
    parameters: tuple[AutopilotParameter, ...]

    def __str__(self) -> str:
        return "\n".join(f"vehicle {self.vehicle}: {parameter}" for parameter in self.parameters)


class AutopilotFound(VehicleEvent):
    sentence = "vehicle {vehicle} has {name}, system {system}"
    name: str
    system: int


class ParametersRead(ParametersEvent):
    """The client has read the parameters that decide how the autopilot reacts to silence."""


class ParametersSet(VehicleEvent):
    """The client has set parameters of the autopilot, and read them back."""

    changes: tuple[tuple[str, float, float], ...]

    def __str__(self) -> str:
        lines = [
            f"vehicle {self.vehicle}: {name} is {after:g} from now on, it was {before:g}"
            for name, before, after in self.changes
        ]
        return "\n".join(lines)


class AutopilotRefused(VehicleEvent):
    sentence = "vehicle {vehicle}: its autopilot refuses to {asked}: {answer}"
    asked: str
    answer: str
    """Name of the MAV_RESULT that the autopilot has answered."""


class AutopilotText(VehicleEvent):
    sentence = "vehicle {vehicle}, its autopilot: {text}"
    text: str
    severity: int
    """MAVLink severity, from 0 (emergency) to 7."""


class AutopilotSaid(Event):
    """Text of a simulated autopilot (`skytether.autopilot`)."""

    text: str
    severity: int
    """MAVLink severity, from 0 (emergency) to 7."""

    def __str__(self) -> str:
        return self.text or "an empty text"


class TextsOmitted(VehicleEvent):
    sentence = "vehicle {vehicle}: {count} more texts of its autopilot are not logged"
    count: int


class AutopilotElsewhere(VehicleEvent):
    sentence = (
        "vehicle {vehicle}: nothing comes from its autopilot at {expected}; {content} from "
        "{came_from} is dropped"
    )
    came_from: str
    expected: str
    content: str


class AutopilotMoved(VehicleEvent):
    """The autopilot of a vehicle on the ground has restarted at another address."""

    sentence = "vehicle {vehicle}: its autopilot is at {after}, it was at {before}"
    before: str
    after: str


class PositionsDropped(VehicleEvent):
    sentence = "vehicle {vehicle}: its positions are dropped: {why}"
    why: str


class ClockSilent(VehicleEvent):
    """A vehicle's autopilot sends messages, but no longer answers TIMESYNC."""

    sentence = (
        "vehicle {vehicle}: its autopilot has not answered TIMESYNC for {silent_s:.0f} s: its time "
        "is extrapolated from earlier answers"
    )
    silent_s: float


class AutopilotMode(VehicleEvent):
    mode: str
    armed: bool

    def __str__(self) -> str:
        armed = "armed" if self.armed else "disarmed"
        return f"vehicle {self.vehicle}: its autopilot is in {self.mode}, {armed}"


class SecondCommander(VehicleEvent):
    sentence = (
        "vehicle {vehicle}: system {system}, component {component} commands its autopilot as "
        "well: {said}"
    )
    system: int
    component: int
    said: str
    """Type of the sender's newest message."""


class SecondPublisher(VehicleEvent):
    topic: str
    nodes: tuple[str, ...]
    """Other nodes of the ROS graph that announced to publish on the topic; may be empty."""

    def __str__(self) -> str:
        who = " or ".join(self.nodes) or "a node without a name"
        return f"vehicle {self.vehicle}: {who} publishes on {self.topic} as well"


class OdometryDropped(VehicleEvent):
    sentence = "vehicle {vehicle}: messages of its odometry are dropped: {why}"
    why: str


class Strays(VehicleEvent):
    """A vehicle deviates from its commands by more than wind and model errors explain."""

    sentence = (
        "vehicle {vehicle} deviates by {off_mps:.1f} m/s from its commands: somebody else commands "
        "it, or it fails"
    )
    off_mps: float
    """Distance of the velocity from the range that the commands explain [m/s]."""


class ParametersUnsafe(ParametersEvent, Failure):
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


class NotTakenOff(Failure):
    sentence = "vehicle {vehicle}: {doing}: {why}"
    doing: str
    why: str


class ArmingAwaited(VehicleEvent):
    sentence = (
        "vehicle {vehicle} is not armed: {why}; arm it again: skytether set SOCKET armed=true, or "
        "on the page"
    )
    why: str


class OriginAwaited(VehicleEvent):
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
