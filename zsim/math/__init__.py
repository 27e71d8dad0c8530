"""Mathematics that several packages share: compiling, quaternions and vectors, frames, the Earth.

Imports errors at most.
"""
