"""A measurement of a real path: probes that go both ways, and what follows from them.

Two endpoints exchange numbered packets (`prober`, `listener`); `analysis` and `fits` are functions
of arrays. The command is `skytether.cli.probe`.
"""
