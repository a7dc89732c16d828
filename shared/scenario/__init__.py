"""Scenarios of flights: keys, files, triggers, desired trajectories, zones, network impairments."""

# This import assigns a module to each table of `registry`.
from skytether.shared.scenario import rooms

__all__ = ["rooms"]
