"""Everything about a flight: its keys, the files that hold them, triggers, trajectories."""

# With these two the tables of what a scenario can name hold what comes with Skytether.
from skytether.shared.scenario import trajectories, triggers

__all__ = ["trajectories", "triggers"]
