"""Measurement of a real path: probes both ways, and their analysis.

Two endpoints exchange numbered packets (`prober`, `listener`); `analysis` and `fits` are functions
of arrays. The command is `skytether.cli.probe`.
"""
