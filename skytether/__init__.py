"""Skytether flies a UAV over a bad network; this package is the `skytether` command."""
