"""Foundations: units of time, random streams, files, hints, errors for users."""
