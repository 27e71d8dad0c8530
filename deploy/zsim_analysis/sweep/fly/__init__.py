"""The workers of a sweep, here or on a Dask cluster, and one run as they fly it."""
