"""Labels of axes in lines that fit their panel: what is longer is cut at the edge of the picture. Pure."""

import re

LEVEL_LETTERS, UPRIGHT_LETTERS = 28, 25  # of PAPER_PT that fit a panel's width and height, three across a page
FORMULA = re.compile(r"\$[^$]*\$")


def wrapped(label: str, letters: int) -> str:
    """Return a label in lines of at most so many letters, broken between words; a formula counts as two letters."""
    lines: list[str] = []
    for each in label.split("\n"):
        line = ""
        for word in each.split():
            longer = f"{line} {word}".strip()
            if line and len(FORMULA.sub("xx", longer)) > letters:
                lines.append(line)
                line = word
            else:
                line = longer
        lines.append(line)
    return "\n".join(lines)
