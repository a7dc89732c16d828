"""Events: reports of an endpoint, as typed values; also the base of all other events.

An endpoint returns its events (`Endpoint.events`); a driver passes them to a log, a flight in
virtual time, or the command that started the process. `str(event)` is a sentence for the operator.
For programs an event is a JSON object whose key `type` is the name of the class.

This module has the events of all flights. Other modules have the events of a vehicle on the ground
(`ground`), autopilots (`aboard`), several paths (`paths`), a standby server (`standby`), processes
(`processes`) and missions (`shared.missions.events`). `shared.telemetry.every_event` imports all
these modules and decodes their events.
"""

from typing import Any, Literal, dataclass_transform

import msgspec

from skytether.shared.law.terms import Difference


def address_text(host: str, port: int) -> str:
    """HOST:PORT as a user writes it, with an IPv6 host in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Event(msgspec.Struct, frozen=True, tag=True):
    """Base of all events; subclasses inherit its settings for msgspec and mypy."""

    sentence = ""
    """Sentence for the operator, with fields and properties in braces; an event whose sentence
    depends on its values defines `__str__`."""

    def __str__(self) -> str:
        return self.sentence.format_map(self)

    def __getitem__(self, name: str) -> Any:
        """Value of the field or property whose name is in braces in `sentence`."""
        return getattr(self, name)


class VehicleEvent(Event):
    vehicle: int


class Failure(VehicleEvent):
    """Event after which a vehicle cannot fly, or cannot continue its flight."""


class ReferenceTooFast(Event):
    sentence = (
        "the desired trajectory needs {speed_mps:.3g} m/s at {at_s:g} s, and the vehicle flies at "
        "most {most_mps:.3g} m/s (model.u_max times model.gain): it cannot follow"
    )
    at_s: float
    """First time in the flight at which the trajectory is too fast [s]."""
    speed_mps: float
    most_mps: float
    """Largest speed of the vehicle along the axis [m/s]."""


class Omitted(Event):
    kind: str
    """Class of the dropped events; "lines" if log lines were dropped because nobody read them."""
    count: int

    def __str__(self) -> str:
        return f"… and {self.count:,} more {self.kind}".replace(",", " ")


class RecordIncomplete(Event):
    sentence = "{file}: {reason}: the record is incomplete, the flight continues"
    file: str
    reason: str
    """Message of the operating system, such as "No space left on device"."""


class Fault(Event):
    traceback: str

    def __str__(self) -> str:
        return f"an error in its code, the flight continues\n{self.traceback.rstrip()}"


class FlowOpened(Event):
    flow: int
    host: str
    port: int

    def __str__(self) -> str:
        return f"flow {self.flow} for {address_text(self.host, self.port)}"


class Returned(Event):
    sentence = (
        "a packet has returned from {times} new addresses, and opens no more flows: the server has "
        "never answered, and its address may lead back to this netem"
    )
    times: int
    """Number of new addresses, one after another, from which the packet has arrived."""


class TooLong(Event):
    """The first packet that netem has dropped because of its length."""

    sentence = (
        "a packet of {size} B is dropped, and so are all longer than network.mtu, which is {most} B"
    )
    size: int
    """Size of the packet's UDP payload [B]."""
    most: int


class Unreachable(Event):
    host: str
    port: int
    reason: str

    def __str__(self) -> str:
        at = address_text(self.host, self.port)
        return f"packets to {at} are lost until it answers: {self.reason}"


class Unauthenticated(Event):
    count: int
    host: str
    port: int
    reason: str

    def __str__(self) -> str:
        newest = f"the newest from {address_text(self.host, self.port)}: {self.reason}"
        return f"{self.count} datagrams dropped so far as forged, repeated or too old, {newest}"


class Degraded(Event):
    """The server has begun to miss too many ticks, or has stopped missing them."""

    degraded: bool

    def __str__(self) -> str:
        return "degraded: ticks are missed" if self.degraded else "ticks are in time again"


class Changed(Event, omit_defaults=True):
    key: str
    before: str
    after: str
    name: str = ""
    """Name that operators use for the key, if it is another one, see `endpoints.directions`."""

    def __str__(self) -> str:
        return f"{self.name or self.key} is {self.after} from now on, it was {self.before}"


class ChangeRefused(Event):
    sentence = "a change is refused: {reason}"
    reason: str
    """Reason for the refusal, with the key, the given and the expected value."""


class PeerEvent(VehicleEvent):
    host: str
    """Host of the other end: the vehicle's in a server's event, the server's in a vehicle's."""
    port: int

    @property
    def peer(self) -> str:
        return address_text(self.host, self.port)


class SessionOpened(PeerEvent):
    sentence = "vehicle {vehicle} flies, from {peer}"


class Leaving(Event):
    """An operator has asked the process to end while vehicles of a mission fly their motions."""

    vehicles: tuple[int, ...]
    most_s: float
    """Longest time until the process ends [s]."""

    def __str__(self) -> str:
        named = ", ".join(map(str, self.vehicles))
        who = f"vehicle {named} has" if len(self.vehicles) == 1 else f"vehicles {named} have"
        waits = f"waits for at most {self.most_s:.0f} s until {who} come to rest"
        return f"asked to end: no new motion begins; {waits} (ask again to end at once)"


class SessionEnded(VehicleEvent):
    """A session has ended: the vehicle has closed it, or was silent for too long."""

    sentence = "the session of vehicle {vehicle} has ended"


class SessionRefused(Failure):
    """Server and vehicle fly different scenarios; each end reports it."""

    differences: tuple[Difference, ...]

    def __str__(self) -> str:
        keys = "; ".join(
            f"{difference.key} is {difference.here} here and {difference.there} at the other end"
            for difference in self.differences
        )
        return f"vehicle {self.vehicle} is refused, it flies another scenario: {keys}"


class ServerFull(PeerEvent):
    sentence = (
        "vehicle {vehicle} from {peer} is refused: the server is full (room for {capacity}); "
        "see --vehicles"
    )
    capacity: int
    """Largest number of vehicles."""


class BegunAnew(VehicleEvent):
    """The client of a vehicle on a mission has restarted, and does not continue its motion."""

    sentence = (
        "vehicle {vehicle}: its client has restarted without its motion; until its first packet "
        "arrives, others keep clear of every place where it may be"
    )


class CannotResume(VehicleEvent):
    sentence = (
        "vehicle {vehicle}: its client cannot save its state; if it restarts, the vehicle stops "
        "where it is"
    )


class NumberTaken(PeerEvent):
    sentence = (
        "vehicle {vehicle} from {peer} is refused: another client flies under this number, from "
        "{holder}; see --id"
    )
    holder: str
    """HOST:PORT of the vehicle that already uses this number."""


class NoSession(PeerEvent, Failure):
    """The server opens no session for a vehicle, which repeats its request."""

    reason: Literal["full", "taken"]

    def __str__(self) -> str:
        why = {
            "full": "the server is full; see its --vehicles",
            "taken": "another client flies under this number; see --id",
        }[self.reason]
        return f"vehicle {self.vehicle} is refused by {self.peer}: {why}"


class Flying(VehicleEvent):
    sentence = "vehicle {vehicle}: session open, flying"


class ModeChanged(VehicleEvent):
    """A vehicle has changed its mode, or the reason for it.

    Coasting along a plan that still lasts is not reported.
    """

    before: str
    """Name of the previous mode, see `shared.wire.protocol.Mode`."""
    after: str
    """Name of the new mode; equal to the old name if only the reason has changed."""
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


class PlanningStopped(VehicleEvent):
    """The server makes no plan for a vehicle with an open session, or sends none."""

    sentence = "vehicle {vehicle} is sent no plan: {why}"
    why: str


class PlanningResumed(VehicleEvent):
    sentence = "vehicle {vehicle} gets plans again"


class StateDoubted(VehicleEvent):
    sentence = "vehicle {vehicle} reports an impossible state: the observation is dropped"


class SteppedLate(VehicleEvent):
    """A step of a vehicle on a mission began too late, with the largest delay so far. The vehicle
    flew its last input until the step began.
    """

    sentence = (
        "a step of vehicle {vehicle} began {late_s:.2f} s late: its computer was busy or stood "
        "still"
    )
    late_s: float
    """Delay of the step's beginning [s]."""


def metres(leap_m: tuple[float, ...]) -> str:
    return f"({', '.join(f'{each:+.2f}' for each in leap_m)}) m"


class StateLeapt(VehicleEvent):
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


class ClockContradicted(VehicleEvent):
    """The packets of a vehicle contradict the bounds of its clock's offset."""

    sentence = "vehicle {vehicle}: {what}"
    what: str


class FenceHolds(VehicleEvent):
    sentence = "vehicle {vehicle} is held back by its fence"


class NotFlown(Failure):
    """A flight has ended without a plan, or never had one."""

    covered: int
    steps: int
    why: str
    """Why there was no plan, as far as the vehicle knows."""

    def __str__(self) -> str:
        flown = f"ended without a plan, after {self.covered} of {self.steps} steps with one"
        return f"vehicle {self.vehicle} {flown if self.covered else 'was never flown'}: {self.why}"


class Finished(VehicleEvent):
    sentence = "vehicle {vehicle}: flown to the end, {missed} of {steps} steps missed"
    steps: int
    missed: int
