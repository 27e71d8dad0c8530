"""The scenario of a run, and what follows from it.

    scenario        the sections and fields of a scenario: types, units, defaults, limits
    scenario_file   a file read, overridden, resolved, and written again as the text of `world/info`
    consistency     checks between fields
    roles           the processes of a run: roles, names, rights on the keys
    faults          faults that can be injected, and how a description of one is checked
    obstacle        distances from obstacles, for the world's compiled code

Imports vehicles, contract, sensors and schema.
"""
