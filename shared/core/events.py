"""Events: reports of an endpoint, or of the process around it, as typed values.

An endpoint returns its events (`Endpoint.events`); a driver passes them to a log, a flight in
virtual time, or the command that started the process. `str(event)` is a sentence for the operator.
For programs an event is a JSON object whose key `type` is the name of the class.
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
    host: str
    port: int
    waiting_for: str

    def __str__(self) -> str:
        address = address_text(self.host, self.port)
        return f"listening on {address}, waiting for {self.waiting_for}"


class HostMissing(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    host: str
    reason: str

    def __str__(self) -> str:
        return f"cannot find {self.host}: {self.reason}; it is looked up again until it is found"


class HostFound(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    host: str
    address: str

    def __str__(self) -> str:
        return f"found {self.host}: it is {self.address}"


class PathMissing(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    path: str
    """LOCAL=HOST:PORT, as the user has written it."""
    reason: str

    def __str__(self) -> str:
        return f"the path {self.path} is down: {self.reason}; it is tried again every second"


class PathFound(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    path: str

    def __str__(self) -> str:
        return f"the path {self.path} is up"


class PathDied(VehicleEvent, frozen=True, kw_only=True):
    """Nothing arrives any more over one of a session's paths."""

    path: int
    """Number of the path, from 0."""
    via: str
    """Its interface or address."""

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: nothing arrives over path {self.path} ({self.via})"


class PathHealed(VehicleEvent, frozen=True, kw_only=True):
    path: int
    via: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: path {self.path} ({self.via}) is well again"


class PageServed(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    address: str
    """Address for a browser; includes a token if the page may change the flight."""
    taken: str = ""
    """Requested HOST:PORT if another process uses that address."""

    def __str__(self) -> str:
        # Only a space may follow the address: it is copied, or clicked.
        return f"the page is at {self.address}" + (
            f" ({self.taken} is taken)" if self.taken else ""
        )


class BrowserRefused(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    why: str
    count: int

    def __str__(self) -> str:
        return f"refused, {self.count} so far: {self.why}"


class Measured(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    host: str
    port: int
    local: bool = True

    def __str__(self) -> str:
        whose = "" if self.local else ", WITHOUT A PASSWORD: anybody on the network can read them"
        return f"metrics at http://{address_text(self.host, self.port)}/metrics{whose}"


class ReferenceTooFast(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    at_s: float
    """First time in the flight at which the trajectory is too fast [s]."""
    speed_mps: float
    most_mps: float
    """Largest speed of the vehicle along the same axis [m/s]."""

    def __str__(self) -> str:
        required = f"the desired trajectory needs {self.speed_mps:.3g} m/s at {self.at_s:g} s"
        most = f"{self.most_mps:.3g} m/s (model.u_max times model.gain)"
        return f"{required}, and the vehicle flies at most {most}: it cannot follow"


class NoFailsafe(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A vehicle is flown without a failsafe: with a lost link it keeps its last input for ever."""

    def __str__(self) -> str:
        flown = "without a packet it holds its last input for ever"
        return f'NO FAILSAFE: {flown}; vehicle.exhausted = "brake" has one'


class Plaintext(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A process has no keys: anybody can read and forge its packets."""

    local: bool

    def __str__(self) -> str:
        who = "on this machine" if self.local else "on the network"
        return f"PLAINTEXT, no keys: anybody {who} can fly the vehicle; see skytether keygen"


class Counted(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    figures: dict[str, Any]

    def __str__(self) -> str:
        return "counted so far:"


class Omitted(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    kind: str
    """Name of the events' class; "lines" if the output was not read in time."""
    count: int

    def __str__(self) -> str:
        return f"… and {self.count:,} more {self.kind}".replace(",", " ")


class RecordIncomplete(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    file: str
    reason: str
    """System's message, such as "No space left on device"."""

    def __str__(self) -> str:
        return f"{self.file}: {self.reason}: the record is incomplete, the flight goes on"


class Fault(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    traceback: str

    def __str__(self) -> str:
        return f"an error in its code, the flight goes on\n{self.traceback.rstrip()}"


class FlowOpened(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    flow: int
    host: str
    port: int

    def __str__(self) -> str:
        return f"flow {self.flow} for {address_text(self.host, self.port)}"


class Returned(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A packet of netem has returned to netem, while the server has never answered."""

    times: int
    """Number of successive new addresses that the packet came from."""

    def __str__(self) -> str:
        return (
            f"a packet has returned from {self.times} new addresses, and opens no more flows: the "
            "server has never answered, and its address may lead back to this netem"
        )


class TooLong(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """The first packet that netem has dropped because of its length."""

    size: int
    """UDP payload [B]."""
    most: int

    def __str__(self) -> str:
        return (
            f"a packet of {self.size} B is dropped, and so are all longer than network.mtu, which "
            f"is {self.most} B"
        )


class Unreachable(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    host: str
    port: int
    reason: str

    def __str__(self) -> str:
        at = address_text(self.host, self.port)
        return f"packets to {at} are lost until it answers: {self.reason}"


class AutopilotSaid(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    text: str
    severity: int
    """MAVLink severity, from 0 (emergency) to 7."""

    def __str__(self) -> str:
        return self.text or "an empty text"


class Unauthenticated(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """A server with keys has dropped datagrams that were forged, repeated or too old."""

    count: int
    host: str
    port: int
    reason: Drop

    def __str__(self) -> str:
        newest = f"the newest from {address_text(self.host, self.port)}: {self.reason}"
        return f"{self.count} datagrams dropped so far as forged, repeated or too old, {newest}"


class Degraded(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """The server has begun to miss too many ticks, or has stopped missing them."""

    degraded: bool

    def __str__(self) -> str:
        return "degraded: ticks are missed" if self.degraded else "ticks are in time again"


class Changed(msgspec.Struct, frozen=True, tag=True, kw_only=True, omit_defaults=True):
    key: str
    before: str
    after: str
    name: str = ""
    """What the operator calls the key, if not by itself, see `core.ways`."""

    def __str__(self) -> str:
        return f"{self.name or self.key} is {self.after} from now on, it was {self.before}"


class ChangeRefused(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    reason: str
    """Reason, which names the key, the given and the expected value."""

    def __str__(self) -> str:
        return f"a change is refused: {self.reason}"


class PeerEvent(VehicleEvent, frozen=True, kw_only=True):
    host: str
    """Host of the vehicle in an event of the server, of the server in an event of the vehicle."""
    port: int

    @property
    def peer(self) -> str:
        return address_text(self.host, self.port)


class SessionOpened(PeerEvent, frozen=True, kw_only=True):
    def __str__(self) -> str:
        return f"vehicle {self.vehicle} flies, from {self.peer}"


class Leaving(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """The process is asked to end while vehicles of a mission are on their motions."""

    vehicles: tuple[int, ...]
    most_s: float
    """Longest time until it ends [s]."""

    def __str__(self) -> str:
        named = ", ".join(map(str, self.vehicles))
        who = f"vehicle {named} has" if len(self.vehicles) == 1 else f"vehicles {named} have"
        waits = f"waits for at most {self.most_s:.0f} s until {who} come to rest"
        return f"asked to end: no new motion begins; {waits} (ask again to end at once)"


class SessionEnded(VehicleEvent, frozen=True, kw_only=True):
    """A session has ended: the vehicle has closed it, or was silent for too long."""

    def __str__(self) -> str:
        return f"the session of vehicle {self.vehicle} has ended"


class SessionRefused(VehicleEvent, frozen=True, kw_only=True):
    """Server and vehicle fly different scenarios; each end reports it."""

    differences: tuple[Difference, ...]

    def __str__(self) -> str:
        keys = "; ".join(
            f"{difference.key} is {difference.here} here and {difference.there} at the other end"
            for difference in self.differences
        )
        return f"vehicle {self.vehicle} is refused, it flies another scenario: {keys}"


class ServerFull(PeerEvent, frozen=True, kw_only=True):
    room: int
    """Largest number of vehicles."""

    def __str__(self) -> str:
        full = f"the server is full (room for {self.room}); see --vehicles"
        return f"vehicle {self.vehicle} from {self.peer} is refused: {full}"


class BegunAnew(VehicleEvent, frozen=True, kw_only=True):
    """The client of a vehicle on a mission has restarted, and does not continue its motion."""

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: its client has restarted without its motion; until its "
            "first packet arrives, others keep clear of every place where it may be"
        )


class CannotResume(VehicleEvent, frozen=True, kw_only=True):
    """A client has told its server that it cannot save the state for its next run."""

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: its client cannot save its state; if it restarts, the "
            "vehicle stops where it is"
        )


class NumberTaken(PeerEvent, frozen=True, kw_only=True):
    holder: str
    """HOST:PORT of the vehicle that already uses this number."""

    def __str__(self) -> str:
        conflict = f"another client flies under this number, from {self.holder}; see --id"
        return f"vehicle {self.vehicle} from {self.peer} is refused: {conflict}"


class NoSession(PeerEvent, frozen=True, kw_only=True):
    """The server opens no session for a vehicle, which keeps asking."""

    reason: Literal["full", "taken"]

    def __str__(self) -> str:
        why = {
            "full": "the server is full; see its --vehicles",
            "taken": "another client flies under this number; see --id",
        }[self.reason]
        return f"vehicle {self.vehicle} is refused by {self.peer}: {why}"


class UnansweredEvent(PeerEvent, frozen=True, kw_only=True):
    others: tuple[str, ...] = ()
    """Addresses of the server's other paths, from which no answer has come either."""

    @property
    def everywhere(self) -> str:
        return ", ".join((self.peer, *self.others))


class NoAnswer(UnansweredEvent, frozen=True, kw_only=True):
    waited_s: float
    secure: bool = False
    """Whether the vehicle has a key, so that only answers with that key count."""

    def __str__(self) -> str:
        key, and_key = (" with this key", ", with this key") if self.secure else ("", "")
        no_answer = f"no answer{key} from {self.everywhere} in {self.waited_s:.0f} s"
        return f"vehicle {self.vehicle}: {no_answer}: is a server running there{and_key}?"


class Unanswered(UnansweredEvent, frozen=True, kw_only=True):
    left_s: float

    def __str__(self) -> str:
        left = f"{self.left_s:.0f} s"
        unheard = f"vehicle {self.vehicle}: no answer from {self.everywhere} yet"
        return f"{unheard}, asking for another {left}"


class Welcomed(PeerEvent, frozen=True, kw_only=True):
    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: session open with the server at {self.peer}"


class ServerSilent(VehicleEvent, frozen=True, kw_only=True):
    """Packets of the server no longer arrive at a vehicle on the ground."""

    silent_s: float

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: the server has been silent for {self.silent_s:.1f} s"


class ServerHeard(VehicleEvent, frozen=True, kw_only=True):
    """Packets of the server arrive again at a vehicle on the ground."""

    silent_s: float

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: its server answers again, after {self.silent_s:.1f} s"


class Flying(VehicleEvent, frozen=True, kw_only=True):
    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: session open, flying"


class LimitsDiffer(PeerEvent, frozen=True, kw_only=True):
    """A server must not lead a vehicle: it plans a mission within other limits than the leader."""

    differences: tuple[Difference, ...]

    def __str__(self) -> str:
        keys = "; ".join(
            f"{difference.key} is {difference.there} there and {difference.here} at the leader"
            for difference in self.differences
        )
        return f"vehicle {self.vehicle}: the server at {self.peer} will not lead it: {keys}"


class LeaderChanged(PeerEvent, frozen=True, kw_only=True):
    """Another server leads a vehicle."""

    number: int
    """Number of the leadership."""

    def __str__(self) -> str:
        at = address_text(self.host, self.port)
        return f"vehicle {self.vehicle}: the server at {at} leads it now (leadership {self.number})"


class ModeChanged(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle has changed its mode, or the reason for it.

    Coasting along a plan that still lasts is not reported.
    """

    before: str
    """Name of the previous mode, see `shared.wire.protocol.Mode`."""
    after: str
    """Name of the new mode; the same if only the reason has changed."""
    reason: str

    def __str__(self) -> str:
        # A recording of another version may contain an unknown name.
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
"""Words for each mode, except coasting along a plan, which is not reported."""


class PlanningStopped(VehicleEvent, frozen=True, kw_only=True):
    """The server makes no plan for a vehicle with an open session, or sends none."""

    why: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} is sent no plan: {self.why}"


class StateDoubted(VehicleEvent, frozen=True, kw_only=True):
    def __str__(self) -> str:
        return f"vehicle {self.vehicle} reports an impossible state: the observation is dropped"


class InZone(VehicleEvent, frozen=True, kw_only=True):
    zone: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle} is at rest in {self.zone}, tube included: it is guided out"


class LeftTube(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle on a mission is farther from its motion than allowed."""

    off_m: float
    """Distance of the vehicle outside its tube [m]."""

    def __str__(self) -> str:
        off = f"{self.off_m:.2g} m outside its tube (mission.tube_m)"
        return f"vehicle {self.vehicle} is {off}: the others keep further away"


class LeftMotion(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle on a mission has left its motion before its end."""

    left_s: float
    """Time until the motion would have ended [s]."""

    def __str__(self) -> str:
        left = f"has left its motion {self.left_s:.1f} s before its end"
        return f"vehicle {self.vehicle} {left}: the others keep away from where it is"


class SteppedLate(VehicleEvent, frozen=True, kw_only=True):
    """A step of a vehicle on a mission began later than any before, and too late: until then the
    last input was flown.
    """

    late_s: float
    """Time by which it began late [s]."""

    def __str__(self) -> str:
        late = f"{self.late_s:.2f} s late: its computer was busy or stood still"
        return f"a step of vehicle {self.vehicle} began {late}"


def metres(leap_m: tuple[float, ...]) -> str:
    return f"({', '.join(f'{each:+.2f}' for each in leap_m)}) m"


class StateLeapt(VehicleEvent, frozen=True, kw_only=True):
    """A vehicle's measured state has leapt, and the operator has to choose a frame."""

    by_m: tuple[float, ...]
    """Displacement of the position on each axis [m]; empty if only the velocity has leapt."""
    land_after_s: float
    """Time of hovering after which the vehicle lands without a choice [s]; 0: never."""

    def __str__(self) -> str:
        leap = f"position has leapt by {metres(self.by_m)}" if self.by_m else "velocity has leapt"
        what = (
            "choose vehicle.after_leap: 'old' (the leap is subtracted, the fence stays), 'new' "
            "(it counts, the fence moves with it) or 'stay'"
        )
        lands = f"; without a choice it lands {self.land_after_s:g} s after it has begun to hover"
        return f"vehicle {self.vehicle}: its {leap}: {what}{lands if self.land_after_s else ''}"


class ClockContradicted(VehicleEvent, frozen=True, kw_only=True):
    """The packets of a vehicle contradict the bounds of its clock's offset."""

    what: str

    def __str__(self) -> str:
        return f"vehicle {self.vehicle}: {self.what}"


class TimeUnknown(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """`link.time_of_day` is "host", but the error of the host's clock is unknown."""

    def __str__(self) -> str:
        return (
            'link.time_of_day is "host", and the kernel of this host does not say how wrong its '
            "clock is: clocks are compared by delays alone (chrony needs `rtcsync` in its "
            "configuration; systemd-timesyncd states no error)"
        )


class FenceHolds(VehicleEvent, frozen=True, kw_only=True):
    def __str__(self) -> str:
        return f"vehicle {self.vehicle} is held back by its fence"


class PlanningResumed(VehicleEvent, frozen=True, kw_only=True):
    def __str__(self) -> str:
        return f"vehicle {self.vehicle} gets plans again"


class NotFlown(VehicleEvent, frozen=True, kw_only=True):
    """A flight has ended without a plan, or never had one."""

    covered: int
    steps: int
    why: str
    """Why there was no plan, as far as the vehicle knows."""

    def __str__(self) -> str:
        flown = f"ended without a plan, after {self.covered} of {self.steps} steps with one"
        return f"vehicle {self.vehicle} {flown if self.covered else 'was never flown'}: {self.why}"


class Recalled(VehicleEvent, frozen=True, kw_only=True):
    goes_on: bool

    def __str__(self) -> str:
        if self.goes_on:
            return f"vehicle {self.vehicle} goes on with the flight of an earlier run"
        return f"vehicle {self.vehicle}: the flight of an earlier run is too long ago to go on"


class NotRecalled(VehicleEvent, frozen=True, kw_only=True):
    reason: str

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: the state saved by an earlier run is not used: {self.reason}"
        )


class SettingsRecalled(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    path: str
    values: dict[str, Any]

    def __str__(self) -> str:
        settings = ", ".join(f"{key} = {value!r}" for key, value in self.values.items())
        return f"set in flight and in force again, from {self.path}: {settings}"


class NotKept(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    reason: str
    removed: bool = False
    """Whether the file of an earlier state was removed: the next run would follow it."""

    def __str__(self) -> str:
        hovers = "; a client that is restarted now hovers where it is" if self.removed else ""
        return f"the state for the next run of this process cannot be saved: {self.reason}{hovers}"


class Finished(VehicleEvent, frozen=True, kw_only=True):
    steps: int
    missed: int

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: flown to the end, {self.missed} of {self.steps} steps missed"
        )


Failure = SessionRefused | NoSession | NoAnswer | NotFlown | AboardFailure

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
    | TooLong
    | Unreachable
    | AutopilotSaid
    | AboardEvent
    | Unauthenticated
    | Degraded
    | Changed
    | ChangeRefused
    | SessionOpened
    | Leaving
    | PathDied
    | PathHealed
    | SessionEnded
    | SessionRefused
    | ServerFull
    | BegunAnew
    | CannotResume
    | NumberTaken
    | NoSession
    | NoAnswer
    | Unanswered
    | HostMissing
    | HostFound
    | PathMissing
    | PathFound
    | Welcomed
    | ServerSilent
    | ServerHeard
    | Flying
    | LeaderChanged
    | LimitsDiffer
    | ModeChanged
    | PlanningStopped
    | StateDoubted
    | InZone
    | ClockContradicted
    | TimeUnknown
    | LeftMotion
    | LeftTube
    | SteppedLate
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
