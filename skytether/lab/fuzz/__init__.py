"""Fuzzing: whatever bytes others send or write, only the documented error comes of it.

A target (`lab.fuzz.target`) takes bytes and raises where a promise is broken; `lab.fuzz.targets`
lists all of them, with what each changes in an input that is right. `python -m skytether.lab.fuzz`
gives them inputs, guided by coverage where atheris is installed.
"""
