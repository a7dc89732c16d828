"""Endpoints (server, client and netem), driven by datagrams and time only, and their events."""
