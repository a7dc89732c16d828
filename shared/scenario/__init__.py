"""Scenarios of flights: keys, files, triggers, desired trajectories, zones, network impairments."""

# It says which module fills which table of `registry`.
from skytether.shared.scenario import rooms

__all__ = ["rooms"]
