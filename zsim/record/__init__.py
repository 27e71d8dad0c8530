"""The record of a run: every message of every key in one MCAP file. Plain I/O, no session.

    RecordWriter(path).add(key, payload, encoding, t_ns, wall_ns)   tick(wall_ns)   close()
    RecordReader(path).messages()   topics()   last(key)
    completeness(reader)            returns the gaps of a record
    repair(path)                    completes a file whose writer died

Topic = key without the federation's prefix, message encoding `msgpack`, log time = simulated time, publish
time = wall clock of the recorder. Other MCAP tools can open the file. Imports contract.
"""

from zsim.record.completeness import Completeness, completeness
from zsim.record.record_reader import Recorded, RecordReader
from zsim.record.record_writer import RecordWriter, repair

__all__ = ["Completeness", "RecordReader", "RecordWriter", "Recorded", "completeness", "repair"]
