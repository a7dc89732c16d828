"""Events of the process that runs an endpoint: addresses, pages, keys, files and figures."""

from typing import Any

from skytether.shared.events.flight import Event, VehicleEvent, address_text


class Listening(Event):
    host: str
    port: int
    waiting_for: str

    def __str__(self) -> str:
        address = address_text(self.host, self.port)
        return f"listening on {address}, waiting for {self.waiting_for}"


class HostMissing(Event):
    sentence = "cannot find {host}: {reason}; it is looked up again until it is found"
    host: str
    reason: str


class HostFound(Event):
    sentence = "found {host}: it is {address}"
    host: str
    address: str


class PathMissing(Event):
    sentence = "the path {path} is down: {reason}; it is tried again every second"
    path: str
    """Path LOCAL=HOST:PORT, as written by the user."""
    reason: str


class PathFound(Event):
    sentence = "the path {path} is up"
    path: str


class PageServed(Event):
    address: str
    """Address for a browser; includes a token if the page may change the flight."""
    taken: str = ""
    """HOST:PORT that was requested but is used by another process; empty if it was free."""

    def __str__(self) -> str:
        # Only a space may follow the address, because users copy or click it.
        taken = f" ({self.taken} is taken)" if self.taken else ""
        return f"the page is at {self.address}{taken}"


class BrowserRefused(Event):
    sentence = "refused, {count} so far: {why}"
    why: str
    count: int


class Measured(Event):
    host: str
    port: int
    local: bool = True

    def __str__(self) -> str:
        whose = "" if self.local else ", WITHOUT A PASSWORD: anybody on the network can read them"
        return f"metrics at http://{address_text(self.host, self.port)}/metrics{whose}"


class NoFailsafe(Event):
    sentence = (
        "NO FAILSAFE: without a packet it holds its last input for ever; "
        'vehicle.exhausted = "brake" enables it'
    )


class Plaintext(Event):
    """A process has no keys: anybody can read and forge its packets."""

    local: bool

    def __str__(self) -> str:
        who = "on this machine" if self.local else "on the network"
        return f"PLAINTEXT, no keys: anybody {who} can fly the vehicle; see skytether keygen"


class Counted(Event):
    sentence = "counted so far:"
    figures: dict[str, Any]


class TimeUnknown(Event):
    sentence = (
        'link.time_of_day is "host", and the kernel of this host does not say how wrong its clock '
        "is: clocks are compared by delays alone (chrony needs `rtcsync` in its configuration; "
        "systemd-timesyncd states no error)"
    )


class Recalled(VehicleEvent):
    goes_on: bool

    def __str__(self) -> str:
        if self.goes_on:
            return f"vehicle {self.vehicle} continues the flight of an earlier run"
        return f"vehicle {self.vehicle}: the flight of an earlier run is too old to be continued"


class NotRecalled(VehicleEvent):
    sentence = "vehicle {vehicle}: the state saved by an earlier run is not used: {reason}"
    reason: str


class SettingsRecalled(Event):
    path: str
    values: dict[str, Any]

    def __str__(self) -> str:
        settings = ", ".join(f"{key} = {value!r}" for key, value in self.values.items())
        return f"set in flight and in force again, from {self.path}: {settings}"


class NotKept(Event):
    reason: str
    removed: bool = False
    """Whether the file with an earlier state was removed, so that no later run uses it."""

    def __str__(self) -> str:
        hovers = "; a client that is restarted now hovers where it is" if self.removed else ""
        return f"the state for the next run of this process cannot be saved: {self.reason}{hovers}"
