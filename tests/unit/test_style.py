"""Tests judge errors by class, field and value, and never compare whole sentences."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
FOLDERS = ("authority", "contract", "unit")
SENTENCE_WORDS = 4
WORD = re.compile(r"[A-Za-z][a-z'’]+[,.;:!?]?")
JUDGES = ("has_terms", "refused")  # see tests/support/refused.py


def judged(tree: ast.AST) -> Iterator[ast.expr]:
    """Yield what a test expects: its asserts, `match=`, and the terms of an error."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):
            yield node.test
        elif isinstance(node, ast.Call):
            yield from (keyword.value for keyword in node.keywords if keyword.arg == "match")
            if ast.unparse(node.func) in JUDGES:
                yield from node.args


def sentences(source: str) -> list[str]:
    """Return the texts of four words or more that a test's source judges, each with its line."""
    texts = [node for root in judged(ast.parse(source)) for node in ast.walk(root) if isinstance(node, ast.Constant)]
    found = {(node.lineno, node.value) for node in texts if isinstance(node.value, str) and is_sentence(node.value)}
    return [f"{line}: {text!r}" for line, text in sorted(found)]


def is_sentence(text: str) -> bool:
    return sum(1 for word in text.split() if WORD.fullmatch(word)) >= SENTENCE_WORDS


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_test_judges_a_sentence(folder: str) -> None:
    files = sorted((TESTS / folder).rglob("*.py"))
    assert files
    assert [f"{file}:{each}" for file in files for each in sentences(file.read_text())] == []


@pytest.mark.parametrize(
    "judgement",
    [
        'assert "drones must be a list" in line',
        'assert line.startswith(f"{name} is not in drones; allowed: {names}, or one")',
        'pytest.raises(E, match="the mass must be positive")',
        'refused(E, "the mass must be positive")',
    ],
)
def test_a_sentence_is_detected(judgement: str) -> None:
    assert len(sentences(judgement)) == 1


@pytest.mark.parametrize(
    "judgement",
    [
        "assert has_terms(line, 'drones[2].mass_kg', '-1.4', '>', '0', '<=', '100')",
        "refused(E, 'zsim certs init lab.yaml --scenario FILE --renew')",
        "said = 'the mass must be positive'",
    ],
)
def test_terms_and_inputs_are_not_sentences(judgement: str) -> None:
    assert sentences(judgement) == []
