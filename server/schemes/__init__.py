"""Schemes of delay compensation, and their shared parts.

    table       the module of a scheme, loaded when a scenario flies with it
    trajectory  splines, fitted by `knots`
    horizons    base of `predictive`, `none` and `committed`: horizons of inputs
    predictive  the paper's; `observer` estimates the disturbance
    committed   with `delay_bound`, `disturbance`, `loss_scenarios`, `replay`, `sent_horizons`
    sent        plans in force, in flight, or lost
    plugins     schemes of plug-ins, guarded by `guarded`

`shared.scenario.schemes` has their names and properties, in the table SCHEMES. The package imports
`server.mpc`, `server.planning` and `shared`; `table` names missions by a string.
"""
