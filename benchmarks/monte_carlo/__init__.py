"""Contenders of part f: as many flights of Test 1 per hour as two cores can simulate.

zsim flies them by `zsim sweep`. The peers have no cluster controller: their drones follow the paths of a zsim flight
(`way`), with the peer's own position controller. A peer runs as two processes, each on a core of its own, that serve
flights over standard input and output (`worker.serve`). Peers run in an environment of their own.
"""
