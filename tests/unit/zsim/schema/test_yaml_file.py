"""YAML documents: what they mean, and what is refused."""

import math
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from refused import refused

from zsim.schema import yaml_file

ROOT = Path(__file__).parents[4]
FILES = sorted([*ROOT.glob("scenarios/**/*.yaml"), *ROOT.glob("examples/**/*.yaml")])
WORDS = st.sampled_from(["0o17", "0x1f", "012", "1:30", "1_0", "yes", "<<", "1e3", ".5", "~", "Null", "2026-01-31"])
SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8) | WORDS
DOCUMENTS = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_our_files_mean_the_same_in_plain_yaml(file: Path) -> None:
    text = file.read_text()
    assert yaml_file.value(text) == yaml.safe_load(text)


@given(DOCUMENTS)
def test_a_written_document_is_read_back_unchanged(document: object) -> None:
    assert yaml_file.value(yaml_file.dump(document)) == document


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e3", 1000.0),
        ("1e-3", 0.001),
        (".5", 0.5),
        ("-.inf", -math.inf),
        (".INF", math.inf),
        ("012", 12),
        ("-7", -7),
        ("0x1f", 31),
        ("0o17", 15),
        ("true", True),
        ("~", None),
        ("", None),
        *[
            (text, text)
            for text in ("yes", "off", "1:30", "1:30:15.5", "1_000", "0b11", "2026-01-31", "<<", "=", "null_")
        ],
    ],
)
def test_words_mean_what_yaml_1_2_says(text: str, value: object) -> None:
    read = yaml_file.value(f"a: {text}")["a"]
    assert (type(read), read) == (type(value), value)


def test_a_merge_key_of_yaml_1_1_is_an_ordinary_key() -> None:
    assert yaml_file.value("<<: {b: 1}\nb: 2") == {"<<": {"b": 1}, "b": 2}


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("a: &x 1\nb: *x", ("line 2", "aliases")),
        ("a: !!python/name:os.system x", ("line 1", "tags")),
        ("a: 1\na: 2", ("line 2", "'a'", "twice")),
        ("a: [1", ("line 1",)),
        ("[" * 100_000, ("nested",)),
        ("[" * 40 + "1" + "]" * 40 + "]", ("line 1",)),
    ],
)
def test_a_refused_document_is_reported_with_the_reason(text: str, terms: tuple[str, ...]) -> None:
    with refused(ValueError, *terms):
        yaml_file.value(text)
