"""Tables, MATLAB files and Foxglove files of a run, made from its record alone.

    make.export(DIR, Format.CSV, OUT, Selection())     writes OUT, all of it or nothing

Order of the files: `form` says what there is, `selection` which messages, `survey` looks through them once, `columns`
lays a message out as a table, `tables` and `matlab` write those, `foxglove` draws; `place` puts what is written in its
place.
"""
