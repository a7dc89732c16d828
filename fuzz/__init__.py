"""Fuzzing: arbitrary bytes from outside must only raise the documented errors.

A target (`fuzz.target`) takes bytes, and raises if a guarantee is broken; `fuzz.targets` lists all
targets, each with its own mutations of valid inputs. `python -m fuzz` feeds inputs to the targets,
guided by coverage if atheris is installed.
"""
