"""Contenders of part a: one world process and N agent processes that only wait for each other.

Each file is one contender and prints one line of JSON, {"steps_per_s": …}. Files of peers run in the environment of
the peers and import nothing but their peer and the standard library.
"""
