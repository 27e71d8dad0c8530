"""YAML that is read by libyaml means what it means read by Python."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from zsim.schema import yaml_file

ROOT = Path(__file__).parents[4]
FILES = sorted([*ROOT.glob("scenarios/**/*.yaml"), *ROOT.glob("examples/**/*.yaml")])
SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8)
DOCUMENTS = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
)
slow = yaml_file._Loader


@pytest.fixture(autouse=True)
def _needs_libyaml() -> None:
    if yaml_file._FastLoader is None:
        pytest.skip("PyYAML is built without libyaml here")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_both_read_our_files_alike(file: Path) -> None:
    text = file.read_text()
    assert yaml_file._is_plain(text)
    assert yaml_file.value(text) == yaml.load(text, Loader=slow)


@given(DOCUMENTS)
def test_both_read_alike_what_was_written(document: object) -> None:
    text = yaml_file.dump(document)
    assert yaml_file.value(text) == yaml.load(text, Loader=slow) == document


@pytest.mark.parametrize("text", ["a: 1e3", "a: 1e-3", "a: 012", "a: 0x1f", "a: yes", "a: 1_000", "a: .5", "a: 12:30"])
def test_both_read_numbers_alike(text: str) -> None:
    assert yaml_file.value(text) == yaml.load(text, Loader=slow)


@pytest.mark.parametrize(
    "text", ["a: 1\t", "a:\t1", "[a,\tb]", "[a?b]", "{a: b?}", "a: |#\n  x", "a: >-#\n  x", "\n\ufeffa: 1"]
)
def test_where_they_differ_python_reads(text: str) -> None:
    assert not yaml_file._is_plain(text)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a: &x 1\nb: *x", "line 2 .*aliases are not allowed"),
        ("a: !!python/name:os.system x", "line 1 .*tags are not allowed"),
        ("a: 1\na: 2", "line 2 .*key 'a' is given twice"),
        ("a: [1", "line 1 "),
        ("[" * 100_000, "nested too deep"),
        ("[" * 60 + "1" + "]" * 60 + "]", "line 1 "),
    ],
)
def test_what_is_refused_says_where(text: str, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        yaml_file.value(text)


def test_what_is_deep_is_read_all_the_same() -> None:
    depth = yaml_file.DEPTH_MAX + 5
    found = yaml_file.value("[" * depth + "]" * depth)
    assert isinstance(found, list)
