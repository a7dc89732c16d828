"""Python library, imported as `skytether`; see docs/python.md.

    flying         `load`, `check`, `fly`, `fly_batch`, which return a `flight.Flight`
    sweeping       `sweep`
    comparing      `compare`
    bad_network    emulates a bad network in front of any server
    pytest_plugin  `bad_network` as a pytest fixture, by the entry point `pytest11`

`skytether.__init__` has the module of each public name, and imports the module when the name is
first used. The library may import any package but `gym`, inside functions; nothing imports the
library.
"""
