"""Impairments of the network: what delays, loses and changes packets, one small class each."""
