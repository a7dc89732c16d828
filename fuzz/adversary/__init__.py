"""Adversary: a search for events in a mission that bring two vehicles together.

`raid` flies a mission with given moves, in which processes have several `lives`; `climb` searches
for the moves. docs/together.md has what was searched.
"""
