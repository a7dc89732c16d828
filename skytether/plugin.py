"""Names that a plug-in imports: the decorators, and the types of its functions' arguments.

docs/python.md describes planners, docs/triggers.md triggers, docs/schemes.md references,
docs/vehicles.md vehicles, docs/network.md impairments. A scheme also imports
`skytether.plugin_scheme`.
"""

from skytether.client.vehicle import Measurement, Vehicle
from skytether.client.vehicles import vehicle
from skytether.netem.impairments.draws import Draws, Fate
from skytether.netem.impairments.impairment import Impairment, Share, Time, impairment
from skytether.server.triggers.trigger import Situation, Trigger, Verdict, above, trigger
from skytether.shared.scenario.curves import reference
from skytether.shared.scenario.planners import Planner, Problem, planner
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import ControlConfig
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Compared

__all__ = [
    "Compared",
    "ControlConfig",
    "Draws",
    "Fate",
    "Impairment",
    "Measurement",
    "Planner",
    "Problem",
    "Reference",
    "Scenario",
    "Share",
    "Situation",
    "Time",
    "Trigger",
    "Vehicle",
    "Verdict",
    "above",
    "impairment",
    "planner",
    "reference",
    "trigger",
    "vehicle",
]
