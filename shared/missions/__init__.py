"""Missions, as a scenario describes them: goals of several vehicles, zones, and their
contradictions. `server.missions` plans them.

Loaded with a scenario that is a mission. It fills the tables of shapes and zones.
"""
