"""Missions whose server restarts: keys set by an operator, and vehicles found inside a zone."""

from lives import Death, Lives
from skytether.shared.missions import zone_texts
from skytether.shared.missions.events import InZone
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario

BOX = "box(-1.5, 1.5, -1.5, 1.5)"
CENTRE = zone_texts.parse(BOX, 2)


def swap() -> Scenario:
    table = reading.to_table(reading.load("swap"))
    table |= {"duration": 50.0, "seed": 3}
    table["link"]["timeout_s"] = 9.0  # a restarted server is detected by its silence
    table["reference"]["shape"] = "swap(4)"
    return reading.check(table, "swap")


def test_a_zone_set_in_flight_is_kept_clear_of_after_a_death_of_the_server() -> None:
    """The zone was free when it was set; without the journal vehicles fly into it."""
    setting = [(3.0, {"mission.zones": BOX})]
    kept = Lives(swap(), deaths=[Death(4.0, 1.0)], settings=setting)
    kept.fly(30.0)
    assert kept.inside_s(CENTRE) == 0.0
    forgotten = Lives(swap(), deaths=[Death(4.0, 1.0, remembers=False)], settings=setting)
    forgotten.fly(30.0)
    assert forgotten.inside_s(CENTRE) > 1.0


def test_a_vehicle_found_at_rest_in_a_zone_is_told_and_led_out() -> None:
    """The server restarted with a zone across motions; all vehicles leave it."""
    flight = Lives(swap(), deaths=[Death(6.0, 0.5, zones="box(-2, 2, -2, 2)")])
    flight.fly(45.0)
    events = [event for _, _, event in flight.events if isinstance(event, InZone)]
    assert events
    assert flight.inside_s(zone_texts.parse("box(-2, 2, -2, 2)", 2), since_s=40.0) == 0.0
    assert flight.least_m() > 0.5
