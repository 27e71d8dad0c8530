"""Mathematics shared by several packages; may import only errors.

compiled: compilation with numba, named columns of arrays; held: arrays as one argument of compiled functions;
elementary: elementary functions with the same bits everywhere; linear: linear algebra; rotation: vectors, quaternions
and poses as tuples of floats, for compiled code; frames: rotations as arrays, and the Earth; randomness: random streams
by name, and distributions.
"""
