"""YAML documents: what they mean, and what is refused."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from refused import refused

from zsim.schema import yaml_file

ROOT = Path(__file__).parents[4]
FILES = sorted([*ROOT.glob("scenarios/**/*.yaml"), *ROOT.glob("examples/**/*.yaml")])
SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8)
DOCUMENTS = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_our_files_mean_what_plain_yaml_means(file: Path) -> None:
    text = file.read_text()
    assert yaml_file.value(text) == yaml.safe_load(text)


@given(DOCUMENTS)
def test_what_was_written_is_read_again(document: object) -> None:
    assert yaml_file.value(yaml_file.dump(document)) == document


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e3", 1000.0), ("1e-3", 0.001), ("012", 10), ("0x1f", 31), ("yes", True), (".5", 0.5), (".inf", float("inf"))],
)
def test_numbers_are_those_of_yaml_and_floats_of_yaml_1_2(text: str, value: object) -> None:
    read = yaml_file.value(f"a: {text}")["a"]
    assert (type(read), read) == (type(value), value)


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
def test_what_is_refused_says_where(text: str, terms: tuple[str, ...]) -> None:
    with refused(ValueError, *terms):
        yaml_file.value(text)
