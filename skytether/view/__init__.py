"""What people look at: the live page, recordings, and what both are made of.

Everything here is made of frames (`shared.telemetry.feed`), whether they come from a feed, a
recording or a flight in virtual time.
"""
