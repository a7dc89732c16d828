"""Fence: bounds that a vehicle does not leave, whatever inputs it receives.

    keys            section `fence` of a scenario (`scenario.rooms.SECTIONS`)
    margins         the bounds moved inwards, for wind and errors of the model
    contradictions  a fence that has no interior, or that the desired trajectory crosses

The section names `client.fence`, the limiter aboard. A client imports the limiter only if the
scenario has a fence. The package imports `shared.law`, `shared.scenario` and `shared.base`.
"""
