"""Events of a vehicle's paths to its server, and of their sockets."""

from skytether.shared.events.flight import Event, VehicleEvent


class PathMissing(Event):
    sentence = "the path {path} is down: {reason}; it is tried again every second"
    path: str
    """LOCAL=HOST:PORT, as the user has written it."""
    reason: str


class PathFound(Event):
    sentence = "the path {path} is up"
    path: str


class PathDied(VehicleEvent):
    sentence = "vehicle {vehicle}: nothing arrives over path {path} ({via})"
    path: int
    """Number of the path, from 0."""
    via: str
    """Its interface or address."""


class PathHealed(VehicleEvent):
    sentence = "vehicle {vehicle}: path {path} ({via}) is well again"
    path: int
    via: str
