"""The parts of a refusal's line, so that a test judges the field and the value and not the sentence."""


def parts(line: str) -> tuple[str, str]:
    """Return where a line says that something is wrong, and what was found there."""
    where, _, rest = line.partition(" is ")
    return where, rest.partition(";")[0]
