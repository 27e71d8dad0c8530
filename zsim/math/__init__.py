"""Mathematics that several packages share; imports errors at most.

compiled: compiling with numba, columns of rows; rotation: vectors, quaternions and poses as tuples of floats, for
compiled code; frames: the same as arrays, and the Earth; randomness: random streams by name, and distributions.
"""
