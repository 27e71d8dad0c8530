"""Contenders of part f: as many flights of Test 1 as two cores can make.

zsim flies them by `zsim sweep`. The peers have no cluster controller: their drones follow the paths of a flight of
zsim (`way`), each with its own position controller. Each file of a peer is a process that serves flights over its
standard input and output (`worker.serve`); two of them run at once, with a core each. Files of peers run in the
environment of the peers.
"""
