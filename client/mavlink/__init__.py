"""A vehicle with an autopilot that speaks MAVLink: ArduCopter or PX4.

    port        messages from the autopilot and to it
    setup       which autopilot it is, and whether its parameters are safe if set-points stop
    launch      mode, arming, take-off and landing, all done by the autopilot
    vehicle     the pilot's interface: velocities in, measurements out

`condition` has the autopilot's newest status, `positions` its measurements, and `clock` converts
its time stamps. Axes, frames and encoding are in `skytether.mavlink`.
"""
