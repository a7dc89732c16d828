"""Impairments of the network, which delay, lose or change packets; all are in IMPAIRMENTS.

    impairment  base class, and an example of an impairment
    direction   the impairments of one direction, parsed from the text of a scenario
    draws       random numbers of impairments, from the seed and the packet

    delays, distributions      random delays
    losses, outages, damage    packets lost, at random or for a time; duplicated and corrupted
    queues                     finite rates and order, for `netem.bottleneck`
    traces                     recorded networks, read by `shared.formats.recorded`

Each impairment is a class, imported when a scenario names it. The package imports only `shared`.
"""
