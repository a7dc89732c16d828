"""Events of a vehicle's paths to its server; `processes` has the events of the paths' sockets."""

from skytether.shared.events.flight import VehicleEvent


class PathDied(VehicleEvent):
    sentence = "vehicle {vehicle}: nothing arrives over path {path} ({via})"
    path: int
    """Number of the path, from 0."""
    via: str
    """Interface or address of the path."""


class PathHealed(VehicleEvent):
    sentence = "vehicle {vehicle}: path {path} ({via}) works again"
    path: int
    via: str
