"""The parts of a refusal's line, so that a test judges the field and the value and not the sentence."""


def parts(line: str) -> tuple[str, str]:
    """Return the field or thing that a line refuses, without the key before it, and its value or state."""
    where, _, rest = line.partition(" is ")
    return where.rpartition(": ")[2], rest.partition("; ")[0]
