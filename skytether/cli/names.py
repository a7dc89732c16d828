"""`skytether triggers`, `skytether reports` and so on: list what a scenario can name."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from skytether.client.vehicles import vehicle
from skytether.shared.scenario import registry
from skytether.shared.scenario.schemes import scheme
from skytether.shell import command, options


@dataclass(frozen=True)
class ListingOptions:
    """Options of the commands that list names."""

    plugin: command.Plugins = ()


def names(title: str, table: registry.PluginTable, about: str, argv: Sequence[str]) -> None:
    """Print how each entry of a table is written, and below it what it does and who adds it."""
    options.read(ListingOptions(), argv, f"skytether {title}", about)
    for name, entry in table.items():
        source = "" if entry.is_ours else f" (from {entry.source})"
        print(f"{entry.form(name)}\n    {entry.about}{source}")


triggers = partial(
    names, "triggers", registry.TRIGGERS, "List what control.trigger is made of, a sentence each."
)
reports = partial(
    names, "reports", registry.REPORTS, "List what vehicle.report is made of, a sentence each."
)
schemes = partial(names, "schemes", scheme, "List what control.scheme may be, a sentence each.")
references = partial(
    names, "references", registry.REFERENCES, "List what reference.shape may be, a sentence each."
)
impairments = partial(
    names,
    "impairments",
    registry.IMPAIRMENTS,
    "List what network.uplink and network.downlink are made of, a sentence each.",
)
vehicles = partial(names, "vehicles", vehicle, "List what vehicle.kind may be, a sentence each.")
