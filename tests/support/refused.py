"""The parts of a refusal's line, so that a test judges the field and the value and not the sentence."""


def parts(line: str) -> tuple[str, str]:
    """Return the field or thing that a line refuses, without the key before it, and its value or state."""
    where, _, rest = line.partition(" is ")
    return where.rpartition(": ")[2], rest.partition("; ")[0]


def missing(line: str, *tokens: str) -> list[str]:
    """Return which of some fields, values, limits and remedies a line does not show, whatever sentence is around them."""
    return [token for token in tokens if token not in line]
