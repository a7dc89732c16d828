"""Drivers of endpoints: sockets, the clock, signals, processes and the command line."""
