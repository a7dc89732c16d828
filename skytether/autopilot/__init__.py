"""Simulated autopilot: a vehicle that speaks MAVLink as ArduCopter or PX4 do, around a quadrotor.

It serves tests, and users without an autopilot. Its response to velocities, lost set-points,
refused commands and landings was measured on both autopilots in simulation; behaviour that
Skytether does not depend on is left out.
"""
