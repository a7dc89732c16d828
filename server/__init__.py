"""The ground side: estimate the vehicle's state, plan, decide when a horizon is worth a packet."""
