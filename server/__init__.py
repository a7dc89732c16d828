"""The ground side: estimate the vehicle's state, plan, decide whether a horizon is worth a packet."""
