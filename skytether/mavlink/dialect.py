"""MAVLink 2 dialect used here: ArduPilot's, which includes PX4's messages.

All other modules import the dialect from here. The dialect takes 14 MB of memory.
"""

from pymavlink.dialects.v20 import ardupilotmega as dialect

__all__ = ["dialect"]
