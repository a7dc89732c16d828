"""A vehicle with an autopilot that speaks MAVLink: ArduCopter or PX4.

    port        messages from and to the autopilot
    connection  the autopilot's address, and the sender of each message
    autopilot   from the first heartbeat to a vehicle that can be flown
    setup       which autopilot it is, and whether its parameters are safe if set-points stop
    launch      mode, arming, take-off and landing, all done by the autopilot
    setpoints   when a desired velocity is sent, and repeated
    hindrances  reasons that forbid following a plan, such as a second commander
    vehicle     the pilot's interface: velocities in, measurements out

`condition` has the autopilot's newest status, `positions` its measurements, and `clock` converts
its time stamps by the answers to `timesync`. Axes, frames and encoding are in `skytether.mavlink`.
"""
