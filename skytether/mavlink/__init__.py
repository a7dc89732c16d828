"""MAVLink, as an autopilot and who flies it both speak it: bytes, axes, parameters.

No module in here has a socket: pymavlink is used to read and write messages, and for nothing else.
"""
