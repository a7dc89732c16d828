"""Live page, recordings, and the data and pictures of both.

The input is frames (`shared.telemetry.feed`), from a feed, a recording or a flight in virtual time.
"""
