"""Fence: bounds that a vehicle does not leave, whatever inputs it receives.

    keys            section `fence` of a scenario (`scenario.rooms.SECTIONS`)
    margins         the bounds moved inwards, for wind and errors of the model
    contradictions  a fence without a place inside, or crossed by the desired trajectory

The section names `client.fence`, the limiter aboard, which a client imports if there is a fence.
The package imports `shared.law`, `shared.scenario` and `shared.base`.
"""
