"""A sweep: one scenario flown many times with different seeds and values of its fields.

    plan = make_plan("step.yaml", document, vary, runs)    a plan, with all combinations checked
    sweep(SweepRequest(plan, DIR, workers=2))              flies the runs that DIR lacks
    make_sweep_report(DIR)                                 distributions with intervals, DIR/report.html

Imports in_process, reading and report.
"""
