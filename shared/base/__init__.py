"""Foundations: units of time, named chance, files, hints, errors for users."""
