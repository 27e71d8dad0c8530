"""A hunt: faults, wind, delays and seeds are drawn for a scenario until a flight breaks a requirement, which is shrunk.

    summary, flown = hunt(HuntRequest(…))         flies, shrinks what it finds, and leaves DIR/violation
    make_hunt_report(request, summary, flown)     margins over flights, what was tried, the violation

Imports in_process, reading, report and sweep.
"""
