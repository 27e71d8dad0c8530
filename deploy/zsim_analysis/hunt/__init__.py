"""A hunt: faults, wind, delays and seeds are drawn until a flight violates a requirement; then its causes are isolated.

    hunted = hunt(HuntRequest(…))     flies, shrinks a violation, and writes DIR/violation
    make_hunt_report(hunted)          margins over flights, combinations tried, the violation

Imports in_process, reading, report and sweep.
"""
