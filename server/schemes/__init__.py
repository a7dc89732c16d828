"""Schemes of delay compensation, and their shared parts."""
