"""The record of a run: every message of every key in one MCAP file. Plain I/O, no session.

    RecordWriter(path).add(key, payload, encoding, t_ns, wall_ns)   tick(wall_ns)   close()
    RecordReader(path).messages()   topics()   last(key)
    completeness(reader)            returns the gaps of a record
    repair(path)                    completes a file whose writer died

In the file, a topic is a key without the federation's prefix, the message encoding is `msgpack`, the log time is
simulated time, and the publish time is the recorder's wall clock. Other MCAP tools can open it. Imports contract.
"""

from zsim.record.completeness import Completeness, completeness
from zsim.record.record_reader import Recorded, RecordReader
from zsim.record.record_writer import RecordWriter, repair

__all__ = ["Completeness", "RecordReader", "RecordWriter", "Recorded", "completeness", "repair"]
