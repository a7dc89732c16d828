"""Schemes of delay compensation, and what they share."""
