"""Fuzzing: whatever bytes a peer sends, no endpoint may raise, nor grow without bound.

`fuzz.targets` takes bytes and raises where a promise is broken, `fuzz.mutators` makes bytes that
are nearly messages, and `python -m fuzz` brings them together, with atheris where it is installed.
"""
