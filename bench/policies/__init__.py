"""Benchmark of a policy on another machine, see `bench.policies.__main__`."""
