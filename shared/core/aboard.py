"""Events about a vehicle's autopilot: its messages, and the client's judgement of them."""

import msgspec


class VehicleEvent(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """Base of the events of one vehicle."""

    vehicle: int
    """Number of the vehicle."""


class AutopilotParameter(msgspec.Struct, frozen=True, kw_only=True):
    """Parameter of an autopilot and its meaning for the flight."""

    name: str
    value: float | None
    """Value; None if the autopilot does not have the parameter."""
    meaning: str
    """Meaning of the value, in words."""
    wanted: str = ""
    """Safe values, and the one to set; empty if the value is safe."""

    def __str__(self) -> str:
        value = "missing" if self.value is None else f"{self.value:g}"
        expected = f"; expected {self.wanted}" if self.wanted else ""
        return f"{self.name} = {value}: {self.meaning}{expected}"


class ParametersEvent(VehicleEvent, frozen=True, kw_only=True):
    """Base of the events about parameters of an autopilot."""

    parameters: tuple[AutopilotParameter, ...]

    def __str__(self) -> str:
        return "\n".join(f"vehicle {self.vehicle}: {parameter}" for parameter in self.parameters)


class AutopilotFound(VehicleEvent, frozen=True, kw_only=True):
    """The client has heard the vehicle's autopilot for the first time."""

    name: str
    """Name and version."""
    system: int
    """Number of its MAVLink system."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} has {self.name}, system {self.system}"


class ParametersRead(ParametersEvent, frozen=True, kw_only=True):
    """The client has read the parameters that decide how the autopilot reacts to silence."""


class ParametersSet(VehicleEvent, frozen=True, kw_only=True):
    """The client has set parameters of the autopilot, and read them back."""

    changes: tuple[tuple[str, float, float], ...]
    """Name, old value and new value of each."""

    def __str__(self) -> str:
        lines = [
            f"vehicle {self.vehicle}: {name} is {after:g} from now on, it was {before:g}"
            for name, before, after in self.changes
        ]
        return "\n".join(lines)


class AutopilotRefused(VehicleEvent, frozen=True, kw_only=True):
    """The autopilot has refused a command."""

    asked: str
    """Command, in words."""
    answer: str
    """Answer of the autopilot, the name of a MAV_RESULT."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: its autopilot refuses to {self.asked}: {self.answer}"


class AutopilotText(VehicleEvent, frozen=True, kw_only=True):
    """The autopilot has sent a status text."""

    text: str
    severity: int
    """MAVLink severity, from 0 (emergency) to 7."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}, its autopilot: {self.text}"


class TextsOmitted(VehicleEvent, frozen=True, kw_only=True):
    """The autopilot has sent more status texts than are logged."""

    count: int
    """Number of texts that were not logged."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: {self.count} more texts of its autopilot are not logged"


class AutopilotWaits(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle on the ground cannot be flown yet."""

    waits_for: str
    """What is missing, in words."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} waits for {self.waits_for}"


class AutopilotElsewhere(VehicleEvent, frozen=True, kw_only=True):
    """Datagrams arrive from another address than that of a silent autopilot, and are dropped."""

    came_from: str
    """HOST:PORT of the sender."""
    expected: str
    """HOST:PORT of the autopilot."""
    content: str
    """Content of the newest datagram, in words."""

    def __str__(self) -> str:
        silent = f"vehicle {self.vehicle}: nothing comes from its autopilot at {self.expected}"
        return f"{silent}; {self.content} from {self.came_from} is dropped"


class AutopilotMoved(VehicleEvent, frozen=True, kw_only=True):
    """The autopilot of a vehicle on the ground is heard from another address after a silence."""

    before: str
    """Old HOST:PORT."""
    after: str
    """New HOST:PORT."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: its autopilot is at {self.after}, it was at {self.before}"


class PositionsDropped(VehicleEvent, frozen=True, kw_only=True):
    """Positions arrive from the autopilot, but none of them can be used."""

    why: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: positions of its autopilot are dropped: {self.why}"


class ClockSilent(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle's autopilot is heard, and does not answer questions for its clock any more."""

    silent_s: float
    """Time since its newest answer [s]."""

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: its autopilot has not answered TIMESYNC for "
            f"{self.silent_s:.0f} s: its clock is followed as it ran until then"
        )


class AutopilotMode(VehicleEvent, frozen=True, kw_only=True):
    """The autopilot has changed its mode, or was armed or disarmed."""

    mode: str
    armed: bool

    def __str__(self) -> str:
        armed = "armed" if self.armed else "disarmed"
        return f"vehicle {self.vehicle}: its autopilot is in {self.mode}, {armed}"


class SecondCommander(VehicleEvent, frozen=True, kw_only=True):
    """Somebody else commands the autopilot."""

    system: int
    """Number of the sender's MAVLink system."""
    component: int
    """Number of its component."""
    said: str
    """Type of its newest message."""

    def __str__(self) -> str:
        who = f"system {self.system}, component {self.component}"
        return f"vehicle {self.vehicle}: {who} commands its autopilot as well: {self.said}"


class Strays(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle deviates from its commands by more than wind and model errors explain."""

    off_mps: float
    """Distance of its velocity from the possible ones [m/s]."""

    def __str__(self) -> str:
        off = f"flies {self.off_mps:.1f} m/s otherwise than it is told"
        return f"vehicle {self.vehicle} {off}: somebody else commands it, or its autopilot fails"


class ParametersUnsafe(ParametersEvent, frozen=True, kw_only=True):
    """A vehicle is not armed because its autopilot would react unsafely to silence, by parameters
    that are unsafe or could not be set.
    """

    sets: bool = False
    """Whether they were to be set."""

    @property
    def brief(self) -> str:
        """Names of the parameters in one line, and what to do."""
        unknown = ", ".join(each.name for each in self.parameters if each.value is None)
        unsafe = ", ".join(each.name for each in self.parameters if each.value is not None)
        does = "could not set" if self.sets else "sets"
        told = [f"{unsafe}; --set-parameters {does} them"] if unsafe else []
        if unknown:
            told.append(f"its autopilot has not answered about {unknown}, or does not have it")
        return f"vehicle {self.vehicle} is not armed: {'; '.join(told)}"


class NotTakenOff(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle is not flown because its take-off has failed."""

    doing: str
    """Stage of the take-off that was not reached."""
    why: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: {self.doing}: {self.why}"


class ArmingAwaited(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle on the ground is not armed until an operator allows it."""

    why: str

    def __str__(self) -> str:
        said = "arm it anew: skytether set SOCKET armed=true, or on the page"
        return f"vehicle {self.vehicle} is not armed: {self.why}; {said}"


class OriginAwaited(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle in the air hovers because the scenario's origin is unknown."""

    place: tuple[float, float, float]
    """Position in the autopilot's local frame: north, east, up [m]."""

    def __str__(self) -> str:
        at = ", ".join(f"{each:.2f}" for each in self.place)
        said = "say where its origin lies there: skytether set SOCKET 'mavlink.origin=[N, E, UP]'"
        return (
            f"vehicle {self.vehicle} hovers at [{at}] of its autopilot's local frame "
            f"(north, east, up), and its origin is not known; {said}"
        )


AboardFailure = ParametersUnsafe | NotTakenOff
"""Events that make a vehicle unusable."""
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
    | Strays
    | AboardFailure
)
