"""MAVLink for autopilot and companion: encoding, axes, parameters.

`client.mavlink` and the simulated autopilot import this package, which imports no other package of
Skytether and opens no socket: pymavlink only encodes and decodes messages.
"""
