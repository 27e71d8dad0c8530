"""Tables, MATLAB files and Foxglove files of a run, made from its record alone.

    export(DIR, Format.CSV, OUT, MessageSelection())     writes OUT, all of it or nothing

`output` has the formats and puts files in their place; `selection` chooses messages, `message_columns` lays them out as
tables, which `tables` and `matlab` write; the modules of Foxglove draw. Imports zsim_analysis.reading.
"""
