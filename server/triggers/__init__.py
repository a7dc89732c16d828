"""Triggers, which decide when a horizon is sent: what a policy is, and our policies."""
