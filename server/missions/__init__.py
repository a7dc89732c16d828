"""Missions: motions that keep several vehicles apart, and out of zones (docs/together-proof.md).

    planning         entry: `schemes.table` imports it if the scenario is a mission
    mission_planner  the planner at each tick
    mission_state    motions that each vehicle may fly (`vehicle_motions`), in arrays for
                     kernels (`possible_motions`, `compiled_motion`)
    led_vehicles     vehicles that follow this server, with a standby server or without
    waypoints        next target of a vehicle: its goal, or a point on its route (`routes`)
    yielding         vehicles at rest that have to move out of the way of others
    trajectory_qp    the QP for a new motion; its constraints: `half_planes`, `separation`,
                     `zone_clearance`

The package registers no plug-ins. It imports `shared.missions`, which has the keys and events, and
`server.planning`, but no other scheme and no trigger.
"""
