"""Missions in a scenario: goals of several vehicles that keep apart, and zones.

    keys            section `mission` of a scenario (`scenario.rooms.SECTIONS`)
    mission         timed goals or paths of several vehicles; goals that change in flight
    shapes          the missions `swap` and `sphere`; missions of files are in `shared.formats`
    zones           polygons that vehicles keep out of, or stay within
    zone_texts      zones written in a scenario, in the table ZONES
    derived         values computed from the keys, such as clearances
    contradictions  values that are each valid, but not together
    events          events of a mission's vehicles (`scenario.rooms.EVENTS`)

`keys` is imported with every scenario, the other modules only with a mission. `server.missions`
plans missions. This package imports `shared.law`, `.scenario`, `.events` and `.base`.
"""
