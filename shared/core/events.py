"""Events: what an endpoint, or the process around it, has to say, as typed values.

An endpoint hands its events out (`Endpoint.events`); a driver gives them to whoever listens: a
log, a flight in virtual time, a command that has started the process. `str(event)` is the
operator's sentence. For a program an event is an object of JSON whose key `type` names the class.
"""

from typing import Any, Literal

import msgspec

from skytether.shared.core.aboard import AboardEvent, AboardFailure, VehicleEvent
from skytether.shared.law.terms import Difference
from skytether.shared.wire.drop import Drop


def address_text(host: str, port: int) -> str:
    """HOST:PORT as a user writes it, with an IPv6 host in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


class Listening(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A process has bound its socket and is about to be driven."""

    host: str
    port: int
    waiting_for: str
    """Peers whose datagrams it waits for."""

    def __str__(self) -> str:
        address = address_text(self.host, self.port)
        return f"listening on {address}, waiting for {self.waiting_for}"


class HostMissing(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """The name of a peer cannot be found yet."""

    host: str
    reason: str

    def __str__(self) -> str:
        return f"cannot find {self.host}: {self.reason}; it is looked up again until it is found"


class HostFound(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """The name of a peer that could not be found before has been found."""

    host: str
    address: str
    """Numeric address of the peer."""

    def __str__(self) -> str:
        return f"found {self.host}: it is {self.address}"


class PageServed(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A page can be looked at."""

    address: str
    """Address for a browser; with a token in it where that may change what flies."""
    taken: str = ""
    """HOST:PORT that it was to have, where somebody else has that."""

    def __str__(self) -> str:
        # Nothing but a space follows the address: it is copied, or clicked at.
        return f"the page is at {self.address}" + (
            f" ({self.taken} is taken)" if self.taken else ""
        )


class BrowserRefused(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A page has turned browsers away, or has dropped what they have sent."""

    why: str
    count: int
    """Number of times that this has happened so far."""

    def __str__(self) -> str:
        return f"refused, {self.count} so far: {self.why}"


class Measured(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A process serves its figures over HTTP, as metrics."""

    host: str
    port: int
    local: bool = True
    """Whether no other machine can read them."""

    def __str__(self) -> str:
        whose = "" if self.local else ", WITHOUT A PASSWORD: anybody on the network can read them"
        return f"metrics at http://{address_text(self.host, self.port)}/metrics{whose}"


class ReferenceTooFast(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """The desired trajectory is faster than the vehicle can fly."""

    at_s: float
    """First time in the flight at which it is too fast [s]."""
    speed_mps: float
    """Desired speed along an axis then [m/s]."""
    most_mps: float
    """Largest speed of the vehicle along this axis [m/s]."""

    def __str__(self) -> str:
        asked = f"the desired trajectory asks {self.speed_mps:.3g} m/s at {self.at_s:g} s"
        most = f"{self.most_mps:.3g} m/s (model.u_max times model.gain)"
        return f"{asked}, and the vehicle flies at most {most}: it cannot follow"


class NoFailsafe(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A vehicle is flown without a failsafe: with a lost link it keeps its last input for ever."""

    def __str__(self) -> str:
        flown = "without a packet it holds its last input for ever"
        return f'NO FAILSAFE: {flown}; vehicle.exhausted = "brake" has one'


class Plaintext(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A process has no keys: what it hears may be anybody's, and anybody may read what it says."""

    local: bool
    """Whether no other machine can reach it, nor be reached."""

    def __str__(self) -> str:
        who = "on this machine" if self.local else "on the network"
        return f"PLAINTEXT, no keys: anybody {who} can fly the vehicle; see skytether keygen"


class Counted(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A process has been asked for its figures, or ends."""

    figures: dict[str, Any]
    """Numbers by name; a dictionary in it is a group of them."""

    def __str__(self) -> str:
        return "counted so far:"


class Omitted(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """Events of a kind were left out, for more have happened than are told one by one."""

    kind: str
    """Name of their class; "lines" where nobody has read what was printed."""
    count: int
    """Number of events that are not told."""

    def __str__(self) -> str:
        return f"… and {self.count:,} more {self.kind}".replace(",", " ")


class RecordIncomplete(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A process could not write all of its part of the record; the flight goes on."""

    file: str
    reason: str
    """Message of the system, such as "No space left on device"."""

    def __str__(self) -> str:
        return f"{self.file}: {self.reason}: the record is incomplete, the flight goes on"


class Fault(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A process has met a mistake in its own code, and goes on."""

    traceback: str
    """Traceback in Python's words."""

    def __str__(self) -> str:
        return f"a mistake in its code, the flight goes on\n{self.traceback.rstrip()}"


class FlowOpened(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """New client, heard by netem."""

    flow: int
    """Number of the flow, from 0."""
    host: str
    port: int

    def __str__(self) -> str:
        return f"flow {self.flow} for {address_text(self.host, self.port)}"


class Returned(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A packet has come back to netem, while the server has never answered."""

    times: int
    """Number of new addresses that it has come from, one after the other."""

    def __str__(self) -> str:
        return (
            f"a packet has come back from {self.times} new addresses, and opens no more flows: the "
            "server has never answered, and its address may lead back to this netem"
        )


class AutopilotSaid(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """An autopilot has said something in words."""

    text: str
    severity: int
    """Severity as MAVLink has it, from 0, an emergency, to 7."""

    def __str__(self) -> str:
        return self.text or "nothing in words"


class Unauthenticated(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A server with keys has dropped datagrams: strangers made them, or they came twice or late."""

    count: int
    """Number of them so far."""
    host: str
    """Host that the newest came from."""
    port: int
    reason: Drop
    """Fault of the newest one."""

    def __str__(self) -> str:
        newest = f"the newest from {address_text(self.host, self.port)}: {self.reason}"
        return f"{self.count} datagrams dropped so far that were no vehicle's, {newest}"


class Degraded(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """The server misses more of its ticks than it may, or has stopped doing so."""

    degraded: bool

    def __str__(self) -> str:
        return "degraded: ticks are missed" if self.degraded else "ticks are in time again"


class Changed(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A key of the scenario has another value from now on."""

    key: str
    before: str
    """Value that it had, as a scenario's file has it."""
    after: str
    """Value that it has."""

    def __str__(self) -> str:
        return f"{self.key} is {self.after} from now on, it was {self.before}"


class ChangeRefused(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A change in flight that was asked for is refused, and nothing is changed."""

    reason: str
    """Why it cannot be; names the key, what was given and what was expected."""

    def __str__(self) -> str:
        return f"a change is refused: {self.reason}"


class SessionOpened(VehicleEvent, frozen=True, kw_only=True):
    """The server has received the first observation of a vehicle's session."""

    host: str
    """Host that the vehicle's HELLO came from."""
    port: int

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} flies, from {address_text(self.host, self.port)}"


class SessionEnded(VehicleEvent, frozen=True, kw_only=True):
    """A session has ended: the vehicle has closed it, or was silent for long."""

    def __str__(self) -> str:
        return f"the session of vehicle {self.vehicle} has ended"


class SessionRefused(VehicleEvent, frozen=True, kw_only=True):
    """Server and vehicle fly different scenarios; each end says so from its own side."""

    differences: tuple[Difference, ...]
    """Keys of the scenario that differ."""

    def __str__(self) -> str:
        keys = "; ".join(
            f"{difference.key} is {difference.here} here and {difference.there} at the other end"
            for difference in self.differences
        )
        return f"vehicle {self.vehicle} is refused, it flies another scenario: {keys}"


class ServerFull(VehicleEvent, frozen=True, kw_only=True):
    """The server has refused a vehicle for which it has no room."""

    host: str
    """Host that the vehicle's HELLO came from."""
    port: int
    room: int
    """Number of vehicles that there is room for."""

    def __str__(self) -> str:
        address = address_text(self.host, self.port)
        full = f"the server is full (room for {self.room}); see --vehicles"
        return f"vehicle {self.vehicle} from {address} is refused: {full}"


class BegunAnew(VehicleEvent, frozen=True, kw_only=True):
    """The client of a vehicle on a mission has begun anew, and does not go on with its motion."""

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: its client has begun anew without its motion; until it is "
            "heard, others keep away from all of that"
        )


class NumberTaken(VehicleEvent, frozen=True, kw_only=True):
    """The server has refused a vehicle whose number is that of another one, which it hears."""

    host: str
    """Host that the refused vehicle's HELLO came from."""
    port: int
    holder: str
    """HOST:PORT of the vehicle that uses this number already."""

    def __str__(self) -> str:
        address = address_text(self.host, self.port)
        taken = f"another client flies under this number, from {self.holder}; see --id"
        return f"vehicle {self.vehicle} from {address} is refused: {taken}"


class NoSession(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle has heard why the server opens no session for it; it goes on asking."""

    host: str
    """Host that it says HELLO to."""
    port: int
    reason: Literal["full", "taken"]
    """Whether the server has no room, or another client flies under the vehicle's number."""

    def __str__(self) -> str:
        why = {
            "full": "the server is full; see its --vehicles",
            "taken": "another client flies under this number; see --id",
        }[self.reason]
        return f"vehicle {self.vehicle} is refused by {address_text(self.host, self.port)}: {why}"


class NoAnswer(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle has given up, never having heard the server."""

    host: str
    """Host that it said HELLO to."""
    port: int
    waited_s: float
    """Time since its first HELLO [s]."""
    secure: bool = False
    """Whether it has a key, so that an answer counts only of those who know it."""

    def __str__(self) -> str:
        address = address_text(self.host, self.port)
        if self.secure:
            said = f"nobody who knows this key answers at {address} in {self.waited_s:.0f} s"
            return f"vehicle {self.vehicle}: {said}"
        return f"vehicle {self.vehicle}: no answer from {address} in {self.waited_s:.0f} s"


class Unanswered(VehicleEvent, frozen=True, kw_only=True):
    """No answer from the server yet; the vehicle keeps asking."""

    host: str
    """Host that it says HELLO to."""
    port: int
    left_s: float
    """Time after which it gives up [s]."""

    def __str__(self) -> str:
        at, left = address_text(self.host, self.port), f"{self.left_s:.0f} s"
        return f"vehicle {self.vehicle}: no answer from {at} yet, asking for another {left}"


class Welcomed(VehicleEvent, frozen=True, kw_only=True):
    """The server has opened a session for a vehicle that cannot be flown yet."""

    host: str
    """Host that the vehicle says HELLO to."""
    port: int

    def __str__(self) -> str:
        at = address_text(self.host, self.port)
        return f"vehicle {self.vehicle}: session open with the server at {at}"


class ServerSilent(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle that is not flown yet hears nothing of the server any more."""

    silent_s: float
    """Time since the newest packet [s]."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: the server has been silent for {self.silent_s:.1f} s"


class ServerHeard(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle that is not flown yet hears the server again."""

    silent_s: float
    """Time without a packet [s]."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: the server is heard again, after {self.silent_s:.1f} s"


class Flying(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle's first session has opened, and with it the flight has begun."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: session open, flying"


class ModeChanged(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle does something else from now on, or the same for another reason.

    That it coasts along a plan that still lasts is not told.
    """

    before: str
    """Name of the mode that it was in, see `shared.wire.protocol.Mode`."""
    after: str
    """Name of the mode that it is in; the same where its reason alone has changed."""
    reason: str

    def __str__(self) -> str:
        # Of another version, or somebody else's recording, the name may be one that is not known.
        does = DOES.get(self.after, f"is in the mode {self.after}")
        return f"vehicle {self.vehicle} {does}: {self.reason}"


DOES = {
    "init": "has no session",
    "sync": "waits for a good link",
    "ready": "waits for a plan",
    "track": "flies a plan",
    "coast": "holds its last input, as vehicle.exhausted says",
    "brake": "brakes",
    "hover": "hovers",
    "land": "lands, and must be checked before it flies again",
    "return": "returns home, and must be checked before it flies again",
    "manual": "is flown by somebody else, or by nobody",
    "fault": "stands still, and must be checked before it flies again",
}
"""Words for each mode, as far as the server is told: along a plan it coasts in silence."""


class PlanningStopped(VehicleEvent, frozen=True, kw_only=True):
    """The server makes no plan for a vehicle that it hears, or sends none."""

    why: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} is sent no plan: {self.why}"


class StateDoubted(VehicleEvent, frozen=True, kw_only=True):
    """The server does not believe the state that a vehicle reports, since it did so before."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} reports a state that it cannot have reached: not believed"


class InZone(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle on a mission was found at rest within a zone, by a server that has just begun."""

    zone: str
    """Zone, as the scenario writes it."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} is at rest in {self.zone}, tube included: it is led out"


class LeftTube(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle of a mission is further from its motion than the others reckon with."""

    off_m: float
    """Distance by which it is outside its tube [m]."""

    def __str__(self) -> str:
        off = f"{self.off_m:.2g} m outside its tube (mission.tube_m)"
        return f"vehicle {self.vehicle} is {off}: the others keep further away"


def metres(leap_m: tuple[float, ...]) -> str:
    """A displacement as an operator reads it."""
    return f"({', '.join(f'{each:+.2f}' for each in leap_m)}) m"


class StateLeapt(VehicleEvent, frozen=True, kw_only=True):
    """What a vehicle measures of itself has leapt, and somebody has to say which frame counts."""

    by_m: tuple[float, ...]
    """Displacement of its position on each axis [m]; empty where its velocity alone has leapt."""
    land_after_s: float
    """Time of hovering after which it lands without a choice [s]; 0: never."""

    def __str__(self) -> str:
        leap = f"position has leapt by {metres(self.by_m)}" if self.by_m else "velocity has leapt"
        what = (
            "choose vehicle.after_leap: 'old' (the leap is subtracted, the fence stays), 'new' "
            "(it counts, the fence moves with it) or 'stay'"
        )
        lands = f"; without a choice it lands {self.land_after_s:g} s after it has begun to hover"
        return f"vehicle {self.vehicle}: its {leap}: {what}{lands if self.land_after_s else ''}"


class ClockContradicted(VehicleEvent, frozen=True, kw_only=True):
    """The packets of a vehicle contradict what was known of its clock."""

    what: str
    """Knowledge that was contradicted, and what follows."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: {self.what}"


class TimeUnknown(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """The time of day is to narrow what is known of clocks, and this host does not know it."""

    def __str__(self) -> str:
        return (
            'link.time_of_day is "host", and the kernel of this host does not say how wrong its '
            "clock is: delays alone tell of clocks (chrony needs `rtcsync` in its configuration; "
            "systemd-timesyncd states no error)"
        )


class FenceHolds(VehicleEvent, frozen=True, kw_only=True):
    """The fence lets less pass than the vehicle was told to fly."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} is held back by its fence"


class PlanningResumed(VehicleEvent, frozen=True, kw_only=True):
    """The server plans for a vehicle again."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} gets plans again"


class NotFlown(VehicleEvent, frozen=True, kw_only=True):
    """The time of a flight is over, and the vehicle has had no plan for long, or never had one."""

    covered: int
    """Number of steps for which it had an input planned."""
    steps: int
    """Number of all steps."""
    why: str
    """Reason for there being none, as far as the vehicle knows."""

    def __str__(self) -> str:
        flown = f"ended without a plan, after {self.covered} of {self.steps} steps with one"
        return f"vehicle {self.vehicle} {flown if self.covered else 'was never flown'}: {self.why}"


class Recalled(VehicleEvent, frozen=True, kw_only=True):
    """A client has found what an earlier run of it has kept."""

    goes_on: bool
    """Whether the flight of that run goes on."""

    def __str__(self) -> str:
        if self.goes_on:
            return f"vehicle {self.vehicle} goes on with the flight of an earlier run"
        return f"vehicle {self.vehicle}: the flight of an earlier run is too long ago to go on"


class NotRecalled(VehicleEvent, frozen=True, kw_only=True):
    """A client does not follow what an earlier run seems to have kept."""

    reason: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: what an earlier run kept is not followed: {self.reason}"


class SettingsRecalled(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """What was set in flight in an earlier run of the process is in force again."""

    path: str
    """Journal that has it."""
    values: dict[str, Any]
    """Values by key."""

    def __str__(self) -> str:
        each = ", ".join(f"{key} = {value!r}" for key, value in self.values.items())
        return f"in force again from {self.path}, as it was set in flight: {each}"


class NotKept(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """What the next run of a process must know cannot be written."""

    reason: str

    def __str__(self) -> str:
        return f"what the next run of this process must know cannot be kept: {self.reason}"


class Finished(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle has begun the last step of its flight."""

    steps: int
    """Steps of the flight."""
    missed: int
    """Steps that it slept through."""

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: flown to the end, {self.missed} of {self.steps} steps missed"
        )


Failure = SessionRefused | NoSession | NoAnswer | NotFlown | AboardFailure
"""Events after which a vehicle cannot fly, or has not."""

Event = (
    Listening
    | PageServed
    | BrowserRefused
    | Measured
    | Plaintext
    | NoFailsafe
    | ReferenceTooFast
    | Counted
    | Omitted
    | RecordIncomplete
    | Fault
    | FlowOpened
    | Returned
    | AutopilotSaid
    | AboardEvent
    | Unauthenticated
    | Degraded
    | Changed
    | ChangeRefused
    | SessionOpened
    | SessionEnded
    | SessionRefused
    | ServerFull
    | BegunAnew
    | NumberTaken
    | NoSession
    | NoAnswer
    | Unanswered
    | HostMissing
    | HostFound
    | Welcomed
    | ServerSilent
    | ServerHeard
    | Flying
    | ModeChanged
    | PlanningStopped
    | StateDoubted
    | InZone
    | ClockContradicted
    | TimeUnknown
    | LeftTube
    | StateLeapt
    | FenceHolds
    | PlanningResumed
    | NotFlown
    | Recalled
    | NotRecalled
    | NotKept
    | SettingsRecalled
    | Finished
)
