"""A ground station that flies a vehicle as people do without Skytether: set-points, straight.

It sends an autopilot MAVLink set-points at every step, through whatever network lies between. It
is here to be compared with: nothing else of Skytether flies by it.
"""
