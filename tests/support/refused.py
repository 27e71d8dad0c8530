"""Checks of errors and notices by class, field, value and allowed bound, never by the sentence around them.

A line of an error contains the place, the value found, what is allowed and what to do, in this order:
`step.yaml: drones[2].mass_kg is -1.4; must be > 0 and <= 100 (drone 'drone3')`. A test lists the terms that carry its
meaning, in the same order: `has_terms(line, "drones[2].mass_kg", "-1.4", "0", "100", "'drone3'")`.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from zsim.errors import ScenarioError

LINE_PUNCTUATION = ",;:.!?`"


def parts(line: str) -> tuple[str, str]:
    """Return the field or thing that a line refuses, without the key in front of it, and its value or state."""
    where, _, rest = line.partition(" is ")
    return where.rpartition(": ")[2], rest.partition("; ")[0]


def has_terms(text: str | None, *terms: str) -> bool:
    """Return whether one line of `text` holds all terms, each as whole words and in this order.

    A term is a field, a value, a bound, an option or a command. A term that ends in `…` stands for all words that begin
    like it, and a relative path for any path that ends in it. Quotes belong to a value; the sentence's punctuation and
    parentheses do not. If the text is None, as for a granted request, no line holds the terms.
    """
    return any(_holds(_words(line), [_words(term) for term in terms]) for line in (text or "").splitlines())


def without_tags(html: str) -> str:
    """Return the text of an HTML page, with its tags replaced by spaces."""
    return re.sub(r"<[^<>]*>", " ", html)


def faults_of(document: dict[str, Any]) -> list[str]:
    """Return the lines with which a document is refused as a scenario."""
    from zsim.scenario import scenario_file  # imported here because its compiled code takes a second to load

    with pytest.raises(ScenarioError) as raised:
        scenario_file.resolve(document)
    return [line.removeprefix("scenario: ") for line in raised.value.faults]


def faulty_fields(document: dict[str, Any], section: str = "") -> list[str]:
    """Return the fields that these lines name, without the prefix `section`."""
    return [line.removeprefix(section).split(" ")[0] for line in faults_of(document)]


@contextmanager
def refused(kind: type[BaseException], *terms: str) -> Iterator[pytest.ExceptionInfo]:
    """Expect an error of this class, one line of which holds the terms."""
    with pytest.raises(kind) as raised:
        yield raised
    assert has_terms(str(raised.value), *terms), f"{raised.value} does not hold {terms}"


def _holds(words: list[str], terms: list[list[str]]) -> bool:
    begin = 0
    for term in terms:
        begin = next((end for end in range(begin + len(term), len(words) + 1) if _same(words, term, end)), 0)
        if not begin:
            return False
    return True


def _same(words: list[str], term: list[str], end: int) -> bool:
    return all(map(_is, words[end - len(term) : end], term))


def _is(word: str, wanted: str) -> bool:
    if wanted.endswith("…"):
        return word.startswith(wanted[:-1])
    return word == wanted or word.endswith(f"/{wanted}")


def _words(text: str) -> list[str]:
    return [word for word in map(_bare, text.split()) if word]


def _bare(word: str) -> str:
    """Return a word without the punctuation around it and without a parenthesis that it only opens or closes."""
    before = None
    while word != before:
        before = word
        word = word.lstrip("`").rstrip(LINE_PUNCTUATION)
        word = word[1:-1] if word.startswith("(") and word.endswith(")") else word
        word = word.removeprefix("(") if word.count("(") > word.count(")") else word
        word = word.removesuffix(")") if word.count(")") > word.count("(") else word
    return word
