"""Contenders of part a: one world process and N agent processes that only wait for each other.

Each module except `lap` is one contender and prints one line of JSON, {"steps_per_s": …}; `paced_zenoh` belongs to part
d. Modules of peers run in the peers' environment, and import only their peer, `lap` and the standard library.
"""
