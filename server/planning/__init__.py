"""Parts of planning common to all schemes: their interface, vehicles' clocks, desired states."""
