"""A sweep: one scenario flown many times, with other seeds and other values of its fields.

    plan = make_plan("step.yaml", document, vary, runs)    checked as a whole
    sweep(SweepRequest(plan, DIR, workers=2))              flies the runs that are missing in DIR
    make_sweep_report(DIR)                                 distributions with intervals, DIR/report.html

Imports in_process, reading and report.
"""
