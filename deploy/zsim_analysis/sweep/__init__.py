"""A sweep: one scenario flown many times, with other seeds and other values of its fields.

    plan = make_plan("step.yaml", document, vary, runs)    what is to be flown; checked as a whole
    sweep(SweepRequest(plan, DIR, workers=2))              flies what DIR does not hold yet
    make_sweep_report(DIR)                                 distributions with intervals, DIR/report.html

`axes` and `design` define the runs; `sweep_run` flies one; `process_pool` and `dask_pool` fly many; `sweep_folder`
keeps their rows; `metrics` calls a function of the user's; `points` computes what `report` shows.
Imports in_process, reading and report.
"""
