"""Drivers of an endpoint in real time: datagrams, streams, changes, and files."""
