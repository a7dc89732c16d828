"""Measurement of a real path: probes in both directions, and their analysis.

    prober, listener  the two endpoints, which exchange the numbered packets of `wire`
    analysis, fits    functions of arrays: figures, and models of delay and loss
    outages           outages that several paths have in common
    recorded          measurements from logs of ping and similar programs
    outcome           results as figures and as text for a scenario

The command is in `skytether.cli.probe`. The package imports `shared`, the client's `ClientLink`,
and the server's gate, which answers only verified addresses.
"""
