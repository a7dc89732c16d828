"""Scenarios of flights: keys, files, triggers, desired trajectories, zones, network impairments."""

# Importing these modules fills the tables of `registry` with the built-in entries.
from skytether.shared.scenario import observing, trajectories, triggers, zones

__all__ = ["observing", "trajectories", "triggers", "zones"]
