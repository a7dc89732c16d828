"""Events of a vehicle on the ground, see `client.ground`."""

from skytether.shared.events.flight import Failure, PeerEvent, VehicleEvent


class UnansweredEvent(PeerEvent):
    others: tuple[str, ...] = ()
    """Addresses of the server's other paths, which have not answered either."""

    @property
    def everywhere(self) -> str:
        return ", ".join((self.peer, *self.others))


class NoAnswer(UnansweredEvent, Failure, kw_only=True):
    waited_s: float
    secure: bool = False
    """Whether the vehicle has a key; it then ignores answers without this key."""

    def __str__(self) -> str:
        key, and_key = (" with this key", ", with this key") if self.secure else ("", "")
        no_answer = f"no answer{key} from {self.everywhere} in {self.waited_s:.0f} s"
        return f"vehicle {self.vehicle}: {no_answer}: is a server running there{and_key}?"


class Unanswered(UnansweredEvent, kw_only=True):
    sentence = (
        "vehicle {vehicle}: no answer from {everywhere} yet, asking for another {left_s:.0f} s"
    )
    left_s: float


class Welcomed(PeerEvent):
    sentence = "vehicle {vehicle}: session open with the server at {peer}"


class AutopilotWaits(VehicleEvent):
    sentence = "vehicle {vehicle} waits for {waits_for}"
    waits_for: str


class ServerSilent(VehicleEvent):
    """Packets of the server no longer arrive at a vehicle on the ground."""

    sentence = "vehicle {vehicle}: the server has been silent for {silent_s:.1f} s"
    silent_s: float


class ServerHeard(VehicleEvent):
    """Packets of the server arrive again at a vehicle on the ground."""

    sentence = "vehicle {vehicle}: its server answers again, after {silent_s:.1f} s"
    silent_s: float
