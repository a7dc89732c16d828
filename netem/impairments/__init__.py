"""Impairments of the network, which delay, lose or change packets: one small class each."""
