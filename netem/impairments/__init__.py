"""Impairments of the network, which delay, lose or change packets, in the table IMPAIRMENTS.

    impairment  base class, and an example of an impairment
    direction   the impairments of one direction, from the text of a scenario
    draws       their random numbers, from the seed and the packet

    delays, distributions      random delays
    losses, outages, damage    packets lost, at random or for a time; duplicated and corrupted
    queues                     finite rates and order, for `netem.bottleneck`
    traces                     recorded networks, by `shared.formats.recorded`

Each is one small class, imported when a scenario names it. The package imports `shared` alone.
"""
