"""Shared by schemes, MPC and missions: clock map, interface of schemes, desired window."""
