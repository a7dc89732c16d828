"""Measurements from LOCAL_POSITION_NED, in our axes."""

from skytether.client import positions
from skytether.client.positions import Vector
from skytether.mavlink.codec import Message
from skytether.mavlink.frames import turned
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.scenario.schema import Scenario


def given_origin(scenario: Scenario) -> Vector | None:
    """Origin given by a scenario, in our axes [m]; None if it is the place of take-off."""
    match scenario.mavlink.origin:
        case "takeoff":
            return None
        case "autopilot":
            return 0.0, 0.0, 0.0
        case (x, y, *up):
            return float(x), float(y), float(up[0]) if up else 0.0
    raise AssertionError(scenario.mavlink.origin)  # `contradictions` has refused all other values


class Positions(positions.Positions):
    def hear(self, message: Message, *, now_ns: int) -> None:
        # The stamp is in whole milliseconds: its middle is the best guess.
        boot_ns = message.time_boot_ms * MILLISECOND_NS + MILLISECOND_NS // 2
        position = turned((message.x, message.y, message.z))
        velocity = turned((message.vx, message.vy, message.vz))
        self.take_in(boot_ns, position, velocity, now_ns=now_ns)
