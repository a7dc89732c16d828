"""Missions: motions that keep several vehicles apart, and out of zones (docs/together-proof.md)."""
