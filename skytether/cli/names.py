"""`skytether triggers`, `skytether reports` and so on: list the names for a scenario's keys."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from skytether.client.vehicles import vehicle
from skytether.shared.scenario import registry
from skytether.shared.scenario.planners import planner
from skytether.shared.scenario.schemes import scheme
from skytether.shell.commandline import command, options


@dataclass(frozen=True)
class ListingOptions:
    plugin: command.Plugins = ()


def names(title: str, table: registry.PluginTable, about: str, argv: Sequence[str]) -> None:
    """Print each entry of a table: its form, and below it a description and its source."""
    options.read(ListingOptions(), argv, f"skytether {title}", about)
    for name, entry in table.items():
        source = "" if entry.is_ours else f" (from {entry.source})"
        print(f"{entry.form(name)}\n    {entry.about}{source}")


triggers = partial(
    names, "triggers", registry.TRIGGERS, "List the policies for control.trigger, a sentence each."
)
reports = partial(
    names, "reports", registry.REPORTS, "List the policies for vehicle.report, a sentence each."
)
schemes = partial(names, "schemes", scheme, "List the values of control.scheme, a sentence each.")
planners = partial(
    names, "planners", planner, "List the values of control.planner, a sentence each."
)
references = partial(
    names, "references", registry.REFERENCES, "List the values of reference.shape, a sentence each."
)
impairments = partial(
    names,
    "impairments",
    registry.IMPAIRMENTS,
    "List the impairments for network.uplink and network.downlink, a sentence each.",
)
vehicles = partial(names, "vehicles", vehicle, "List the values of vehicle.kind, a sentence each.")
