"""Fuzzing: what comes from outside must only raise documented errors, and fly nothing unsafe.

A target (`fuzz.target`) takes bytes, and raises if a guarantee is broken; `fuzz.targets` lists all
targets, each with its own mutations of valid inputs. `python -m fuzz` feeds inputs to the targets,
guided by coverage if atheris is installed. `python -m fuzz.torture` flies through faults and
attacks, `python -m fuzz.adversary` searches for events that bring vehicles of a mission together.
"""
