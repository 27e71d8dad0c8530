"""What a world was handed, and its checkpoints, on disk: one that died goes on from there. Imports zsim alone."""
