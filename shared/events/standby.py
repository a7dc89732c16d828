"""Events of a vehicle with a leader and a standby server."""

from skytether.shared.events.flight import PeerEvent
from skytether.shared.law.terms import Difference


class LimitsDiffer(PeerEvent):
    """A server must not lead a vehicle: its motions have other limits than the leader's."""

    differences: tuple[Difference, ...]

    def __str__(self) -> str:
        keys = "; ".join(
            f"{difference.key} is {difference.there} there and {difference.here} at the leader"
            for difference in self.differences
        )
        return f"vehicle {self.vehicle}: the server at {self.peer} will not lead it: {keys}"


class LeaderChanged(PeerEvent):
    sentence = "vehicle {vehicle}: the server at {peer} leads it now (leadership {number})"
    number: int
    """Leadership number."""
