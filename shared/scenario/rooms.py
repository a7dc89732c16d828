"""Entries, keys and sections of scenarios, and the modules that define them.

Help texts and documents list sections in the order of this module. The modules are imported when
they are used.
"""

from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import Any

from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario.registry import (
    IMPAIRMENTS,
    MPC,
    PLANNERS,
    REFERENCES,
    REPORTS,
    TRIGGERS,
    VEHICLES,
    Files,
    PluginTable,
    load,
)

SHARED, NETEM = "skytether.shared.", "skytether.netem."
TRIGGER = "skytether.server.triggers."

APART = ("swap", "sphere", "mission", "show")
"""Shapes with goals or paths of several vehicles that keep apart."""
SCHEME_APART = "skytether.server.missions.planning"
"""Module of the scheme that flies the shapes of APART, in place of `control.scheme`."""
HORIZONS = f"{SHARED}scenario.horizons"
"""Module that checks for contradictions in scenarios whose scheme sends horizons of inputs."""
FROM_FILE = ("csv", "mission", "show")
"""Shapes that are read from `reference.file`."""
ZONES = PluginTable(
    "zone", "zones such as 'box(1, 2, -1, 1) & fence(-6, 6, -6, 6)'", given=0, class_=0, texts=True
)
"""Zones of `mission.zones`: functions that return a list of zones. See `shared.missions.zones`.
Plug-ins cannot add zones."""

SECTIONS = {
    "link": "skytether.client.standby.keys",
    "fence": f"{SHARED}fence.keys",
    "mission": f"{SHARED}missions.keys",
    "mavlink": "skytether.client.mavlink.keys",
    "ros2": "skytether.client.ros2.keys",
}
"""Module of each optional section, or of the optional keys of a section. `SECTION` in the module is
the section's class."""

FILES = {"mission.zones": (ZONES, 4_000_000)}
"""Keys of optional sections whose text may name files, see `reading.FILES`."""

TEXTS: Mapping[str, PluginTable] = MappingProxyType(
    {
        "control.trigger": TRIGGERS,
        "control.planner": PLANNERS,
        "reference.shape": REFERENCES,
        "vehicle.report": REPORTS,
        "network.uplink": IMPAIRMENTS,
        "network.downlink": IMPAIRMENTS,
    }
)
"""For each key whose value is a text with arguments, the table of the entries in the text."""
EVENTS = (
    f"{SHARED}events.aboard",
    f"{SHARED}events.ground",
    f"{SHARED}events.paths",
    f"{SHARED}events.standby",
    f"{SHARED}missions.events",
    "skytether.policy.events",
)
"""Modules with events of optional packages, see `shared.telemetry.every_event`."""


def sections() -> dict[str, Any]:
    """Optional sections whose packages are installed, by name."""
    found = {}
    for name, module in SECTIONS.items():
        with suppress(ConfigError):
            found[name] = load(module, name).SECTION
    return found


def dead_time() -> Any:
    """Module for a model with a dead time."""
    return load(f"{SHARED}law.dead_time", "model.dead_time_s")


def trigger(control: Any, capacity: int) -> Any:
    """See `server.triggers.trigger.make_trigger`."""
    made = load("skytether.server.triggers.trigger", "control.trigger")
    return made.make_trigger(control, capacity)


def impairments(text: str, files: Files) -> Any:
    """See `netem.impairments.direction.impairments`."""
    return load(f"{NETEM}impairments.direction", "network.uplink").impairments(text, files)


REFERENCES.offer(f"{SHARED}scenario.curves", "circle", "figure-eight")
REFERENCES.offer(f"{SHARED}scenario.points", "square", "waypoints", "hover")
REFERENCES.offer(f"{SHARED}formats.shapes", "csv")
REFERENCES.offer(f"{SHARED}scenario.targets", "target")
REFERENCES.offer(f"{SHARED}scenario.points", "live")
REFERENCES.offer(f"{SHARED}missions.shapes", "swap", "sphere")
REFERENCES.offer(f"{SHARED}formats.shapes", "mission", "show")

REPORTS.offer("skytether.client.report_policies", "always", "periodic", "deviation")
REPORTS.offer("skytether.client.reports", "silence")

TRIGGERS.offer(f"{TRIGGER}schedules", "always")
TRIGGERS.offer(f"{TRIGGER}policies", "heartbeat")
TRIGGERS.offer(f"{TRIGGER}schedules", "periodic")
TRIGGERS.offer(f"{TRIGGER}gaps", "state_gap", "cost_gap")
TRIGGERS.offer(f"{TRIGGER}policies", "expected_gap")
TRIGGERS.offer(f"{TRIGGER}further", "deviation", "send_on_delta", "self_triggered")
TRIGGERS.offer(f"{TRIGGER}schedules", "silence")
TRIGGERS.offer(f"{TRIGGER}further", "budget")

VEHICLES.offer("skytether.client.simulated.vehicle", "simulated", "quadrotor")
VEHICLES.offer("skytether.client.mavlink.kind", "mavlink")
VEHICLES.offer("skytether.client.ros2.kind", "ros2")

PLANNERS.offer(f"{SHARED}scenario.planners", MPC)

IMPAIRMENTS.offer(f"{NETEM}impairments.delays", "constant", "paper")
IMPAIRMENTS.offer(f"{NETEM}impairments.distributions", "uniform", "normal", "lognormal", "gamma")
IMPAIRMENTS.offer(f"{NETEM}impairments.losses", "none", "loss")
IMPAIRMENTS.offer(f"{NETEM}impairments.outages", "gilbert_elliott", "outage", "outages")
IMPAIRMENTS.offer(f"{NETEM}impairments.outages", "delivered")
IMPAIRMENTS.offer(f"{NETEM}impairments.damage", "duplicate", "corrupt")
IMPAIRMENTS.offer(f"{NETEM}impairments.traces", "trace")
IMPAIRMENTS.offer(f"{NETEM}impairments.queues", "ordered", "rate")
IMPAIRMENTS.offer(f"{NETEM}impairments.traces", "deliveries")

ZONES.offer(f"{SHARED}missions.zone_texts", "box", "cylinder", "polygon", "fence", "corridor")
ZONES.offer(f"{SHARED}formats.zones", "geojson", "kml", "plan")
