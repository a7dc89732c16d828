"""MAVLink for both ends, autopilot and companion: bytes, axes, parameters.

No module of this package has a socket: pymavlink only encodes and decodes messages.
"""
