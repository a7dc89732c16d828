"""`skytether list KIND`: names of scenarios, or names that a key of a scenario accepts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from skytether.cli.commands import KINDS
from skytether.client.vehicles import vehicle
from skytether.shared.scenario import reading, registry
from skytether.shared.scenario.forms import form
from skytether.shared.scenario.planners import planner
from skytether.shared.scenario.schemes import scheme
from skytether.shell.commandline import command, options
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, CommandError

TABLES: Mapping[str, registry.PluginTable] = {
    "triggers": registry.TRIGGERS,
    "reports": registry.REPORTS,
    "schemes": scheme,
    "planners": planner,
    "references": registry.REFERENCES,
    "impairments": registry.IMPAIRMENTS,
    "vehicles": vehicle,
}


@dataclass(frozen=True)
class ListOptions:
    kind: Annotated[str, Argument(metavar="|".join(KINDS), positional=True)] = ""
    """Kind of names to list; without it, this help is printed."""
    plugin: command.Plugins = ()


def list_names(argv: Sequence[str]) -> None:
    """List scenarios, or names that a scenario can use, with a sentence about each.

    The kinds are

      scenarios     that come with Skytether
      triggers      policies for control.trigger
      reports       policies for vehicle.report
      schemes       for control.scheme
      planners      for control.planner
      references    shapes for reference.shape
      impairments   for network.uplink and network.downlink
      vehicles      for vehicle.kind
    """
    chosen = options.read(ListOptions(), argv or ["--help"], "skytether list", list_names.__doc__)
    if chosen.kind == "scenarios":
        names = reading.names()
        width = max(map(len, names))
        for name in names:
            print(f"{name:{width}}  {reading.load(name).title}")
    elif chosen.kind in TABLES:
        for name, entry in TABLES[chosen.kind].items():
            source = "" if entry.is_ours else f" (from {entry.source})"
            print(f"{form(name, entry)}\n    {entry.about}{source}")
    else:
        raise CommandError(f"got {chosen.kind}, expected {', '.join(KINDS)}", CONFIGURATION)
