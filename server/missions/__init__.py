"""Missions: motions of several vehicles that keep apart, and out of zones (docs/together.md)."""
