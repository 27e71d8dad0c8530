"""Contenders of part f: flights of Test 1, as many as two cores make.

zsim flies them by `zsim sweep`. The peers have no cluster controller: their drones follow the ways of a flight of
zsim's (`way`), each by its own position controller. Each file of a peer is a process that serves flights over its
standard input and output (`worker.serve`); two of it, a core each, are asked at once. Files of peers run in the
environment of the peers.
"""
