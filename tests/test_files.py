"""Strict reading: each kind of bad file is one error with its line."""

from __future__ import annotations

import os
import pickle
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field

from conftest import is_long
from stiffopt.documents import read_document, write_file
from stiffopt.errors import FileError, InputError, MissingExtraError, StiffoptError
from stiffopt.files import line_of, read_file, save_file
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Length


class Part(Schema):
    length: Length
    count: int = 1


class Whole(Schema):
    name: str
    parts: Items[Part] = ()
    spare: Part | None = None
    hidden: str = Field(default="", exclude=True)


def written(folder: Path, text: str | bytes, name: str = "x.yaml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(folder: Path, text: str | bytes) -> FileError:
    with pytest.raises(FileError) as caught:
        read_file(written(folder, text), "robot", Whole)
    assert "\n" not in str(caught.value)
    return caught.value


HEAD = "format: stiffopt-robot/1\n"


def test_the_message_names_file_line_key_and_reason() -> None:
    error = FileError("problems/x.yaml", "'90' has no unit", line=12, key="target.position[0]")
    assert str(error) == "problems/x.yaml:12: target.position[0]: '90' has no unit"
    assert str(FileError(Path("a"), "is empty")) == "a: is empty"
    assert (error.path, error.line, error.key) == ("problems/x.yaml", 12, "target.position[0]")
    assert isinstance(error, InputError)
    assert isinstance(error, ValueError)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_missing_extra_says_how_to_get_it() -> None:
    error = MissingExtraError("matplotlib", "plot")
    assert "pip install 'stiffopt[plot]'" in str(error)
    assert "matplotlib" in str(error)
    assert isinstance(error, StiffoptError)


def test_a_good_file_is_read(tmp_path: Path) -> None:
    text = HEAD + "# a comment\nname: arm\nparts:\n  - length: 90 mm\n    count: 2\n"
    whole = read_file(written(tmp_path, text), "robot", Whole)
    assert whole == Whole(name="arm", parts=[Part(length=0.09, count=2)])
    assert hash(whole) == hash(Whole(name="arm", parts=(Part(length=0.09, count=2),)))


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", None, "is empty"),
        ("# only a comment\n", None, "is empty"),
        ("---\n...\n", None, "is empty"),
        ("- 1\n", 1, "expected a mapping"),
        ("just text\n", 1, "expected a mapping"),
        (b"format: \xff\xfe\n", 1, "is not UTF-8 text"),
        (b"a: 1\nb: \xff\n", 2, "is not UTF-8 text"),
        (b"a: \x00\n", None, "is not valid YAML"),
        ("a: 1\nb: [1, 2\n", 3, "is not valid YAML"),
        ("a: 1\n\tb: 2\n", 2, "is not valid YAML"),
        ("a: 1\n---\nb: 2\n", 2, "a second document begins here"),
        ("a: 1\nb: 2\na: 3\n", 3, "duplicate key, first given on line 1"),
        ("1: a\n", 1, "'1' is not text; expected a name as the key"),
        ("true: a\n", 1, "'true' is not text"),
        ("a:\n  1.5: b\n", 2, "a: '1.5' is not text"),
        ("? [a, b]\n: c\n", 1, "this is not text"),
        ("a: &x 1\nb: *x\n", 1, "anchors (&) and aliases (*) are not allowed"),
        ("a: 1\nb: *x\n", 2, "anchors (&) and aliases (*) are not allowed"),
        ("a: !!python/object:os.system 1\n", 1, "os.system' is not allowed; remove it"),
        ("a: 1\nb: !mine 1\n", 2, "the tag '!mine' is not allowed"),
        ("a: " + "[" * 40 + "]" * 40, 1, "is nested more than 20 levels deep"),
        ("a: " + "[" * 200_000, 1, "is nested more than 20 levels deep"),
        ("a: " + "{b: " * 40 + "1" + "}" * 40, 1, "is nested more than 20 levels deep"),
        ("a: " + "x" * 1_000_000, None, "is larger than 1 MB"),
        ("name: arm\n", None, "has no 'format'; expected 'format: stiffopt-robot/1'"),
        ("fromat: x\n", None, "(is 'fromat' meant to be that?)"),
        ("\nformat: stiffopt-task/1\n", 2, "this is a task file, expected a robot file"),
        ("format: stiffopt-robot/2\n", 1, "version 2 is not supported"),
        ("format: robot\n", 1, "'robot' is not a format; expected 'stiffopt-robot/1'"),
        ("format: 1\n", 1, "1 is not a format"),
        ("format: [a]\n", 1, "a list is not a format"),
        (HEAD + "name:\n", 2, "name: has no value; give it one or remove it"),
        (HEAD + "name: ~\n", 2, "name: has no value"),
        (HEAD + "parts: []\n", 1, "the key 'name' is missing"),
        (HEAD + "name: 5\n", 2, "name: expected text, not 5"),
        (HEAD + "name: a\nprats: []\n", 3, "prats: unknown key; did you mean 'parts'?"),
        (HEAD + "name: a\nzzz: []\n", 3, "unknown key; the keys here are name, parts, spare"),
        (HEAD + "name: a\nparts: 5\n", 3, "parts: expected a list, not 5"),
        (HEAD + "name: a\nspare: 5\n", 3, "spare: expected a mapping, not 5"),
        (HEAD + "name: a\nspare:\n  count: 2\n", 3, "spare: the key 'length' is missing"),
        (
            HEAD + "name: a\nparts:\n  - length: 1 m\n  - lenght: 1 m\n    length: 2 m\n",
            5,
            "parts[1].lenght: unknown key; did you mean 'length'?",
        ),
        (HEAD + "name: a\nparts:\n  - {length: 90}\n", 4, "parts[0].length: bare number 90 has no"),
        (HEAD + "name: a\nspare: {length: .nan}\n", 3, "spare.length: nan is not a finite number"),
        (HEAD + "name: a\nspare: {length: -.inf}\n", 3, "-inf is not a finite number"),
        (HEAD + "name: a\nspare:\n  length: 1 m\n  count: x\n", 5, "spare.count: "),
    ],
)
def test_a_bad_file_is_one_error_with_its_line(
    tmp_path: Path, text: str | bytes, line: int | None, message: str
) -> None:
    error = refusal(tmp_path, text)
    assert message in str(error)
    assert error.line == line
    assert error.path == str(tmp_path / "x.yaml")


def test_all_mistakes_are_told_at_once(tmp_path: Path) -> None:
    text = HEAD + "nmae: a\nspare: {length: 90}\nparts:\n  - {length: 9 kg}\n"
    error = refusal(tmp_path, text)
    assert (error.line, error.key) == (1, None)
    assert error.reason.startswith("the key 'name' is missing; also ")
    for other in (
        "line 2: nmae: unknown key; did you mean 'name'?",
        "line 3: spare.length: bare number 90",
        "line 5: parts[0].length: '9 kg': 'kg' is not a unit of length",
    ):
        assert f"also {other}" in error.reason


def test_messages_stay_short_and_on_one_line(tmp_path: Path) -> None:
    many = "".join(f"key{n}: 1\n" for n in range(5000))
    error = refusal(tmp_path, HEAD + "name: a\n" + many)
    assert error.reason.endswith("; and 4990 more")
    error = refusal(tmp_path, HEAD + 'name: a\n"a\\nb\\e": 1\nspare: {length: "1\\n\\e"}\n')
    assert r"a\nb\x1b: unknown key" in str(error)
    assert r"'1\n\x1b'" in str(error)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.yaml: there is no such file"):
        read_document(tmp_path / "none.yaml")
    with pytest.raises(FileError, match="is a folder; expected a file"):
        read_document(tmp_path)
    with pytest.raises(FileError, match="cannot be read: not a directory"):
        read_document(written(tmp_path, "a: 1") / "x.yaml")
    with pytest.raises(FileError, match="cannot be read: embedded null byte"):
        read_document("a\0b")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission(tmp_path: Path) -> None:
    path = written(tmp_path, "a: 1")
    path.chmod(0)
    with pytest.raises(FileError, match="cannot be read: permission denied"):
        read_document(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *((word, word) for word in ("free", "yes", "no", "on", "off", "y", "1:30", "1_000")),
        ("2026-01-02", "2026-01-02"),
        ("1e-3", 1e-3),
        ("1.", 1.0),
        ("+.5E3", 500.0),
        ("012", 12),
        ("0x1F", 31),
        ("0o17", 15),
        ("-7", -7),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("", None),
        (".inf", float("inf")),
        ("'1e-3'", "1e-3"),
        ('"true"', "true"),
        ("'a: b'", "a: b"),
        ("|\n  text\n", "text\n"),
        ("<<", "<<"),
    ],
)
def test_scalars_mean_what_yaml_1_2_says(tmp_path: Path, text: str, value: Any) -> None:
    read = read_document(written(tmp_path, f"a: {text}\n")).data["a"]
    assert read == value
    assert type(read) is type(value)


def test_a_byte_order_mark_does_no_harm(tmp_path: Path) -> None:
    assert read_document(written(tmp_path, b"\xef\xbb\xbfa: 1\n")).data == {"a": 1}


def test_lines_of_keys_and_items(tmp_path: Path) -> None:
    path = written(tmp_path, "# top\na:\n  b: 1\n  c:\n    - 1\n    - 2\n")
    lines = read_document(path).lines
    assert (lines["a",], lines["a", "b"], lines["a", "c", 1]) == (2, 3, 6)
    assert line_of(path, "a", "c") == 4
    assert line_of(path, "b") is None
    assert line_of(tmp_path / "none", "b") is None


@settings(max_examples=300 if is_long() else 100)
@given(st.binary(max_size=60) | st.text(alphabet="a:b -[]{}&*!|>'\"\n\t#%,?.1~", max_size=60))
def test_no_text_crashes_the_reader(tmp_path_factory: Any, text: str | bytes) -> None:
    path = written(tmp_path_factory.getbasetemp(), text, "fuzz.yaml")
    with suppress(FileError):
        read_document(path)


plain_text = st.text(
    st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), max_size=12
) | st.sampled_from(["yes", "1e3", "0o17", "null", "", "1:30", "~", ".nan", " a", "- b", "x\ny"])
anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**9), 10**9)
    | st.floats(allow_nan=False)
    | plain_text,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["a", "yes", "1:30", "b c", "é"]), inner, max_size=3)
    ),
    max_leaves=12,
)


@settings(max_examples=200 if is_long() else 60, deadline=None)
@given(st.dictionaries(st.sampled_from(["a", "b", "yes"]), anything, min_size=1))
def test_what_is_written_is_read_back(tmp_path_factory: Any, data: dict[str, Any]) -> None:
    path = tmp_path_factory.getbasetemp() / "round.yaml"
    write_file(path, data)
    assert read_document(path).data == data


def test_writing_takes_arrays_and_shares_nothing(tmp_path: Path) -> None:
    shared = [1.0, 2.0]
    path = tmp_path / "out.yaml"
    write_file(path, {"a": np.eye(2), "b": shared, "c": shared, "d": np.float64(1e-5), "e": path})
    text = path.read_text(encoding="utf-8")
    assert "&" not in text
    assert read_document(path).data == {
        "a": [[1.0, 0.0], [0.0, 1.0]],
        "b": shared,
        "c": shared,
        "d": 1e-5,
        "e": str(path),
    }
    with pytest.raises(InputError, match="a set cannot be written"):
        write_file(path, {"a": {1}})
    assert path.read_text(encoding="utf-8") == text


def test_writing_is_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.yaml"
    write_file(path, {"a": 1})
    write_file(path, {"a": 2})
    assert read_document(path).data == {"a": 2}
    assert os.listdir(tmp_path) == ["out.yaml"]
    link = tmp_path / "link.yaml"
    link.symlink_to(path)
    write_file(link, {"a": 3})
    assert link.is_symlink()
    assert read_document(path).data == {"a": 3}


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="cannot be written: is a directory"):
        write_file(tmp_path, {"a": 1})
    with pytest.raises(FileError, match="cannot be written: no such file or directory"):
        write_file(tmp_path / "none" / "x.yaml", {"a": 1})


def test_a_description_is_saved_as_a_file_of_its_kind(tmp_path: Path) -> None:
    whole = Whole(name="1e3", parts=[Part(length=0.09)])
    save_file(tmp_path / "x.yaml", "robot", whole)
    assert "length: 90 mm" in (tmp_path / "x.yaml").read_text(encoding="utf-8")
    assert read_file(tmp_path / "x.yaml", "robot", Whole) == whole


def test_mistakes_in_a_call_are_input_errors() -> None:
    with pytest.raises(InputError) as caught:
        Whole(name="a", prats=[])
    assert str(caught.value) == "Whole.prats: unknown key; did you mean 'parts'?"
    with pytest.raises(InputError, match=r"Whole\.parts\[0\]: the key 'length' is missing"):
        Whole(name="a", parts=[{}])
    with pytest.raises(InputError, match=r"Whole\.name: expected text, not 5; also Whole\.spare"):
        Whole(name=5, spare=3)
    with pytest.raises(InputError, match="expected a list, not 'ab'"):
        Whole(name="a", parts="ab")


def test_descriptions_do_not_change() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Part(length=1.0).length = 2.0  # type: ignore[misc]


def test_a_validator_can_blame_a_key() -> None:
    assert BadKeyError("a.0.b", "no").loc == ("a", 0, "b")
