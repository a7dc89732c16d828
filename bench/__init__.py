"""Benchmarks: costs of Skytether, measured beside those of other programs in the same run."""
