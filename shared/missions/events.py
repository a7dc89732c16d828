"""Events of a mission's vehicles, reported by the server that plans the mission."""

from skytether.shared.events.flight import VehicleEvent


class InZone(VehicleEvent):
    sentence = "vehicle {vehicle} is at rest in {zone}, tube included: it is guided out"
    zone: str


class LeftTube(VehicleEvent):
    sentence = (
        "vehicle {vehicle} is {off_m:.2g} m outside its tube (mission.tube_m): the others keep "
        "further away"
    )
    off_m: float
    """Distance of the vehicle outside its tube [m]."""


class LeftMotion(VehicleEvent):
    sentence = (
        "vehicle {vehicle} has left its motion {left_s:.1f} s before its end: the others keep away "
        "from where it is"
    )
    left_s: float
    """Time until the motion would have ended [s]."""
