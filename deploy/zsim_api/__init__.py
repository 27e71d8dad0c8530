"""zsim from Python: flights, sweeps and tests of a notebook, a script or a test suite.

What is public is reached as `zsim.NAME`. Imports all other packages but zsim_deploy.
"""
