"""MAVLink for both ends, autopilot and companion: bytes, axes, parameters.

`client.mavlink` and the simulated autopilot import it. It imports nothing of ours, and no module
has a socket: pymavlink only encodes and decodes messages.
"""
