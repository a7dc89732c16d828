"""The server: estimates the vehicles' states, plans, and decides when to send a plan."""
