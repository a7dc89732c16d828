"""MAVLink for autopilot and companion: encoding, axes, parameters.

`client.mavlink` and the simulated autopilot import this package. The package imports no other
package of Skytether, and opens no socket: it uses pymavlink only to encode and decode messages.
"""
