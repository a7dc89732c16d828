"""Ground station that flies a vehicle by set-points only, as autopilots are usually flown.

The station sends an autopilot MAVLink set-points at every step, over any network in between. It is
a baseline for comparison.
"""
