"""Library behind `import skytether`; see docs/python.md.

    flying         `load`, `check`, `fly`, `fly_batch`, which return a `flight.Flight`
    sweeping       `sweep`
    comparing      `compare`
    bad_network    a bad network in front of any server
    pytest_plugin  it as a fixture, by the entry point `pytest11`

`skytether.__init__` names the module of each public name and imports it when it is first used. The
library imports any package but `gym`, and only what a function needs; nothing imports the library.
"""
