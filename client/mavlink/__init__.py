"""A vehicle with an autopilot that speaks MAVLink: ArduCopter or PX4.

    keys        section `mavlink` of a scenario (`scenario.rooms.SECTIONS`)
    kind        `vehicle.kind = "mavlink"`, in the table VEHICLES
    vehicle     the pilot's interface: velocities in, measurements out
    port        messages from and to the autopilot
    connection  the autopilot's address, and the sender of each message
    autopilot   states from the first heartbeat to a vehicle that can be flown
    setup       identification of the autopilot, and check of its parameters (`safety`)
    launch      mode, arming, take-off and landing, all done by the autopilot
    setpoints   times at which a desired velocity is sent, and repeated
    hindrances  reasons that forbid following a plan, such as a second commander (`rivals`)

`condition` has the autopilot's newest status, `positions` and `receiver` have its measurements, and
`timesync` asks for the time on its clock. Axes, frames and encoding are in `skytether.mavlink`. The
package imports `skytether.mavlink`, `shared` and, from the client, the interface of a vehicle, its
clock, positions and filter. `keys` and `kind` load without the extra `mavlink`.
"""
