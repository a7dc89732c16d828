"""The one dialect of MAVLink 2 that is spoken here: ArduPilot's, which has PX4's in it.

Everything else imports it from here. It is 14 MB in memory.
"""

from pymavlink.dialects.v20 import ardupilotmega as dialect

__all__ = ["dialect"]
