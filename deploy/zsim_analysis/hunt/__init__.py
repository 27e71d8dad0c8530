"""A hunt: faults, wind, delays and seeds are drawn for a scenario until a flight breaks a requirement, which is shrunk.

    hunted = hunt(HuntRequest(…))     flies, shrinks a violation, and leaves DIR/violation
    make_hunt_report(hunted)          margins over flights, combinations tried, the violation

Imports in_process, reading, report and sweep.
"""
