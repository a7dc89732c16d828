"""What scenarios can name, and the module that adds it: a module is imported when it is named.

The order is that of help texts and documents. Nothing is imported here.
"""

from collections.abc import Collection
from contextlib import suppress
from typing import Any

from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario.registry import (
    IMPAIRMENTS,
    REFERENCES,
    REPORTS,
    TRIGGERS,
    ZONES,
    load,
)

SHARED = "skytether.shared."

EVENTS = (f"{SHARED}missions.events",)
"""Modules with events of rooms, see `shared.telemetry.every_event`."""


def of_missions() -> Any:
    """Module with the contradictions of missions."""
    return load(f"{SHARED}missions.contradictions", "missions")


REFERENCES.offer(
    f"{SHARED}scenario.trajectories", "circle", "figure-eight", "square", "waypoints", "hover"
)
REFERENCES.offer(f"{SHARED}formats.shapes", "csv")
REFERENCES.offer(f"{SHARED}scenario.trajectories", "target", "live")
REFERENCES.offer(f"{SHARED}missions.shapes", "swap", "sphere")
REFERENCES.offer(f"{SHARED}formats.shapes", "mission", "show")

REPORTS.offer(f"{SHARED}scenario.observing", "always", "periodic", "deviation", "silence")

TRIGGERS.offer(
    f"{SHARED}scenario.triggers",
    "always",
    "heartbeat",
    "periodic",
    "state_gap",
    "cost_gap",
    "expected_gap",
)
TRIGGERS.offer("skytether.server.triggers", "deviation", "send_on_delta", "self_triggered")
TRIGGERS.offer(f"{SHARED}scenario.triggers", "silence")
TRIGGERS.offer("skytether.server.triggers", "budget")

IMPAIRMENTS.offer(
    f"{SHARED}scenario.air.delays", "constant", "paper", "uniform", "normal", "lognormal", "gamma"
)
IMPAIRMENTS.offer(
    f"{SHARED}scenario.air.losses",
    "none",
    "loss",
    "gilbert_elliott",
    "outage",
    "outages",
    "duplicate",
    "corrupt",
)
IMPAIRMENTS.offer(f"{SHARED}formats.traces", "trace")
IMPAIRMENTS.offer(f"{SHARED}scenario.air.queues", "ordered", "rate")
IMPAIRMENTS.offer(f"{SHARED}formats.traces", "deliveries")

ZONES.offer(f"{SHARED}missions.zone_texts", "box", "cylinder", "polygon", "fence", "corridor")
ZONES.offer(f"{SHARED}formats.zones", "geojson", "kml", "plan")


def preload(changeable: Collection[str]) -> None:
    """Import what a change of these keys in flight may name, before the first packet: a step or a
    packet would have to wait for it.
    """
    for key, table in (
        ("control.trigger", TRIGGERS),
        ("mission.zones", ZONES),
        ("network.uplink", IMPAIRMENTS),
    ):
        for name in table if key in changeable else ():
            with suppress(ConfigError):  # a room that is not installed
                _ = table[name]
    if "network.uplink" in changeable:
        load("skytether.netem.bottleneck", "rate")
