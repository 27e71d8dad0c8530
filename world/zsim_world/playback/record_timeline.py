"""What happened when in a record, for who looks for it."""

from typing import Any

from zsim.contract import keys, messages
from zsim.contract.run_messages import Event
from zsim.errors import DecodeError
from zsim.record import RecordReader

MARKS_MAX = 400  # on a timeline; more would be narrower than a pixel
LEFT_OUT = frozenset({"command", "end"})  # kinds of events: what was commanded is too much to be marked
TEXT_MAX = 120  # characters


def timeline_marks(reader: RecordReader) -> list[dict[str, Any]]:
    """Return the events on record, but for commands: t_s, kind and text of each; of many, evenly thinned out."""
    marks = [_mark(event) for event in _events(reader) if event.kind not in LEFT_OUT]
    return marks[:: -(-len(marks) // MARKS_MAX) or 1]


def _events(reader: RecordReader) -> list[Event]:
    events = []
    for recorded in reader.messages([keys.EVENT]):
        try:
            events.append(messages.decode(keys.EVENT, recorded.payload))
        except DecodeError:
            continue
    return events


def _mark(event: Event) -> dict[str, Any]:
    text = f"{event.subject}: {event.text}" if event.subject else event.text
    return {"t_s": event.t_ns / 1e9, "kind": event.kind, "text": text[:TEXT_MAX]}
