"""Fence: bounds that a vehicle does not leave, whatever inputs it receives; see `client.fence`."""
