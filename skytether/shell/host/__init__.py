"""Functions of the operating system: sockets, timers, files, and optional features."""
