"""Drivers of endpoints: sockets, clock, signals, processes and command line."""
