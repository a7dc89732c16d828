"""The client: receives plans, chooses the input of each step, flies it, and reports the state."""
