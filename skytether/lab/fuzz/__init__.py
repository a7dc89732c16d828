"""Fuzzing: arbitrary bytes from outside may only raise the documented error.

A target (`lab.fuzz.target`) takes bytes, and raises if a guarantee is broken; `lab.fuzz.targets`
lists all targets, each with its own mutations of valid inputs. `python -m skytether.lab.fuzz` feeds
them inputs, guided by coverage if atheris is installed.
"""
