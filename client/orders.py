"""Orders of an operator in flight: keys of the scenario that may change while a vehicle flies.

`armed` allows plans to be flown. After a leap of the position, `vehicle.after_leap` decides whether
the old or the new position is right. Servers and vehicles define further keys.
"""

from operator import attrgetter

from skytether.client.alone import OneServer
from skytether.client.failsafe import Failsafe
from skytether.client.pilot import Pilot
from skytether.client.vehicle import Vehicle
from skytether.shared.events.flight import metres
from skytether.shared.scenario.catalogue import DECISIONS, keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.schema import Scenario

ARMED = keys_of(InFlight.ARMED)
"""Key with which an operator allows plans to be flown."""
AFTER_LEAP = "vehicle.after_leap"
LEAP = keys_of(InFlight.LEAP)
"""Key with which an operator decides which position is right after a leap."""


class Orders:
    """Orders to one vehicle."""

    def __init__(
        self, flies: Vehicle, pilot: Pilot, failsafe: Failsafe, servers: OneServer
    ) -> None:
        self._flies, self._pilot = flies, pilot
        self._failsafe, self._servers = failsafe, servers

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:
        """Why an order is refused at present; empty if it is accepted.

        After a leap, an order that arms the vehicle also has to decide which position is right.
        """
        if keys & self._servers.keys and (objection := self._servers.objection(scenario)):
            return objection
        for key in sorted(keys & DECISIONS.keys() - LEAP - self._servers.keys):
            if (got := attrgetter(key)(scenario)) != (only := DECISIONS[key]):
                return f"{key}: got {got!r}, expected {only!r} without a standby server"
        leap_m, choice = self._pilot.leap_m, scenario.vehicle.after_leap
        if leap_m is None and keys & LEAP and choice != "ask":
            return f"{AFTER_LEAP}: got {choice!r}, expected 'ask' before its position has leapt"
        if choice == "old" and keys & LEAP and self._flies.leap_m is None:
            expected = "expected 'new' or 'stay': the vehicle has not subtracted the leap"
            return f"{AFTER_LEAP}: got 'old', {expected}"
        if leap_m is not None and "armed" in keys and scenario.armed and not keys & LEAP:
            expected = f"expected {AFTER_LEAP} = 'old', 'new' or 'stay' with it"
            return f"armed: got true after its position has leapt by {metres(leap_m)}, {expected}"
        return self._flies.objection(scenario, keys)

    def obey(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        """Act on an order: `keys` have new values in `scenario`."""
        self._failsafe.armed = scenario.armed
        if keys & ARMED and scenario.armed:
            self._flies.arm()
        if keys & LEAP:
            match scenario.vehicle.after_leap:
                case "old" | "new" as frame:
                    self._pilot.decide(keeps_frame=frame == "old")
                case choice:
                    self._failsafe.stays = choice == "stay"
        if keys & self._servers.keys:
            self._servers.obey(scenario, now_ns=now_ns)
        if keys & self._flies.changeable:
            self._flies.change(scenario)
