"""A vehicle with an autopilot that speaks MAVLink: ArduCopter or PX4.

    port        what comes from the autopilot and goes to it, in bytes and time
    setup       which autopilot it is, and whether what it does in silence is safe
    launch      mode, arming, take-off and landing, all of them the autopilot's own
    vehicle     what the pilot knows of all that: velocities in, measurements out

`condition` has what the autopilot has said of itself last, `positions` what it has measured, and
`clock` when that was. Axes, frames and bytes are those of `skytether.mavlink`.
"""
