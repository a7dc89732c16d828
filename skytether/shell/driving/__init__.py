"""Drivers of an endpoint in real time: its sockets, changes of keys in flight, and its files."""
