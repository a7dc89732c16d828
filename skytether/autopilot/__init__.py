"""A scripted autopilot: a vehicle that speaks MAVLink as ArduCopter or PX4 do, around a quadrotor.

It is for tests, and for users without an autopilot. What it does with velocities, with silence,
with a refusal and a landing is what was measured of the two in simulation; what nobody flies by is
left out.
"""
