"""Simulated autopilot: a vehicle that speaks MAVLink as ArduCopter or PX4 do, around a quadrotor.

    endpoint   MAVLink in datagrams, and a quadrotor that flies meanwhile
    flight     arming, modes, the motion in each mode, failsafes
    flavours   differences between `ardupilot` and `px4`, as tables
    telemetry  messages made from a flight
    faults     faults at times counted from arming

It serves tests, and users without an autopilot, as `skytether autopilot`. Its response to
velocities, lost set-points, refused commands and landings was measured on both autopilots in
simulation; behaviour that Skytether does not depend on is left out. Nothing is registered. The
package imports `skytether.mavlink`, `quadrotor` and `shared`, and only `__main__` the shell; the
client never imports it.
"""
