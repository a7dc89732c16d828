"""Scenarios of flights: their keys, the files that hold them, triggers, trajectories."""

# With these the tables of what a scenario can name hold what comes with Skytether.
from skytether.shared.scenario import observing, trajectories, triggers, zones

__all__ = ["observing", "trajectories", "triggers", "zones"]
