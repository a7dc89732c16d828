"""Live page, recordings, and the data and pictures that both are made of.

Everything here is made of frames (`shared.telemetry.feed`), from a feed, a recording or a flight in
virtual time.
"""
