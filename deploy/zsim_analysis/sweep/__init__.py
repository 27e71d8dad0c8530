"""A sweep: one scenario flown many times, with other seeds and other values of its fields.

    plan = make_plan("step.yaml", document, vary, runs)    what is to be flown; checked as a whole
    sweep(Order(plan, DIR, workers=2))                     flies what DIR does not hold yet
    make_sweep_report(DIR)                                 distributions with intervals, DIR/report.html

Order of the files: `axes`, `places`, `plan` and `design` say what is flown; `task`, `flight` and `row` fly one run;
`worker`, `pool` and `dask_pool` fly many; `journal`, `table` and `folder` keep what is done; `screen` shows it; `sweep`
puts them together. `intervals`, `points`, `figures`, `page` and `report` make the report.
"""
