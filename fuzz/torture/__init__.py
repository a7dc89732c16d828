"""Torture: the real endpoints under faults and attacks, with invariants checked at every step.

`trials` flies a schedule of `faults`, which the attackers of `saboteur` carry out; `invariants` and
`courses` check what is flown. docs/torture.md lists faults and invariants.
"""
