"""Endpoints: interface of server, client and netem, driven by datagrams and time only."""
