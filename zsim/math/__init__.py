"""Mathematics that several packages share.

    compiled         compiling with numba; columns of rows
    rotation         vectors, quaternions and poses as tuples of floats, for compiled code
    frames           the same as arrays; the Earth
    random_streams   random streams by name

Imports errors at most.
"""
