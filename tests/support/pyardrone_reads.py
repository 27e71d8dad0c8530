"""Print as JSON what the unmodified pyardrone reads from a navdata packet or a video header on standard input."""

import json
import sys


def numbers(value):
    """Return the numbers of a field, flattened in order."""
    if isinstance(value, bytes):
        return list(value)
    return [number for each in value for number in numbers(each)] if hasattr(value, "__len__") else [float(value)]


def fields(structure):
    """Return the numbers of a structure, field by field."""
    return [number for name, *_ in structure._fields_ for number in numbers(getattr(structure, name))]


if sys.argv[1] == "navdata":
    from pyardrone.navdata import NavData

    read = {
        name: fields(option) for name, option in vars(NavData(sys.stdin.buffer.read())).items() if name != "checksum"
    }
else:
    from pyardrone.video import PaVE

    header = PaVE.from_buffer_copy(sys.stdin.buffer.read())
    read = {name: numbers(getattr(header, name)) for name, *_ in header._fields_}
print(json.dumps(read))
