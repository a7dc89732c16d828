"""Simulated autopilot: a simulated quadrotor that speaks MAVLink as ArduCopter or PX4 does.

    endpoint   MAVLink in datagrams, and the quadrotor's flight
    flight     arming, modes, the motion in each mode, failsafes
    flavours   differences between `ardupilot` and `px4`, as tables
    telemetry  messages made from a flight
    faults     faults at times counted from arming

`skytether autopilot` runs the simulated autopilot, for tests and for users without an autopilot.
Responses to velocities, lost set-points, refused commands and landings were measured on both
autopilots in simulation; behaviour that Skytether does not depend on is left out. The package
imports `skytether.mavlink`, `quadrotor` and `shared`; only `__main__` imports the shell. The client
never imports the package.
"""
