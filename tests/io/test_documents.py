"""JSON and YAML from anywhere: read as meant, or refused in one line before it takes the machine's memory."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from synthetless.config import RecipeError, load_recipe
from synthetless.errors import UserError
from synthetless.io.documents import MAX_BYTES, parse_document, read_document, shown

LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
)
"""A billion laughs: ten lines that stand for 10^10 values."""

HOSTILE = {
    "laughs": (LAUGHS, "stands for more than 500000 values"),
    "laughs as a setting": (LAUGHS + "images: *a9\n", "stands for more than 500000 values"),
    "merged laughs": (
        "a: &a {k0: 1, k1: 1}\n"
        + "".join(f"b{i}: &b{i} [*a, {'*b' + str(i - 1) if i else 1}]\n" for i in range(3))
        + "c: "
        + "[" * 70
        + "]" * 70
        + "\n",
        "nested deeper than 64 levels",
    ),
    "itself": ("a: &a [*a]\n", "contains itself"),
    "itself in a mapping": ("a: &a {b: {c: *a}}\n", "contains itself"),
    "deep lists": ("[" * 5000 + "]" * 5000, "nested deeper than 64 levels"),
    "deep lists in JSON": ('{"a": ' + "[" * 100_000 + "]" * 100_000 + "}", "nested deeper than 64 levels"),
    "deep mappings": ("\n".join(" " * i + f"k{i}:" for i in range(200)), "nested deeper than 64 levels"),
    "a Python object": ("a: !!python/object/apply:os.system [ls]\n", "could not determine a constructor"),
    "an unknown tag": ("a: !nobody 3\n", "could not determine a constructor"),
    "a wrong tag": ("a: !!int many\n", "cannot read|neither"),
    "a key twice": ("images: 3\nseed: 1\nimages: 4\n", "'images' is listed twice"),
    "a key twice inside": ("camera: {width: 3, width: 4}\n", "'width' is listed twice"),
    "a key twice in JSON": ('{"images": 3, "images": 4}', '"images" occurs twice'),
    "a list as a key": ("? [a, b]\n: 3\n", "neither|cannot read"),
    "no such date": ("a: 2001-13-45\n", "cannot read|neither"),
    "a tab": ("a:\n\t- b\n", "neither JSON nor YAML"),
    "an open bracket": ("a: [1, 2\n", "neither JSON nor YAML"),
    "an unknown alias": ("a: *nobody\n", "undefined alias"),
    "two documents": ("a: 1\n---\nb: 2\n", "expected a single document"),
    "control characters": ("a: \x07\n", "neither JSON nor YAML"),
    "a merge of a number": ("a: {<<: 3}\n", "neither JSON nor YAML"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_what_cannot_be_meant_is_refused_in_one_line(kind: str) -> None:
    text, message = HOSTILE[kind]
    with pytest.raises(UserError, match=message) as error:
        parse_document(text, "recipe.yaml")
    assert str(error.value).startswith("recipe.yaml: ")
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_recipe_is_refused_alike_from_a_file_and_from_set(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text(HOSTILE[kind][0])
    with pytest.raises(RecipeError) as error:
        load_recipe(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(RecipeError) as error:
        load_recipe(None, [f"objects.ids={HOSTILE[kind][0]}"])
    assert "\n" not in str(error.value)


def test_refusing_takes_no_memory_to_speak_of(tmp_path: Path) -> None:
    """The laughs would take gigabytes."""
    path = tmp_path / "recipe.yaml"
    path.write_text(LAUGHS)
    code = f"from synthetless.config import load_recipe; from pathlib import Path; load_recipe(Path({str(path)!r}))"

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (2 * 2**30, 2 * 2**30))

    done = subprocess.run([sys.executable, "-c", code], preexec_fn=limit, capture_output=True, text=True, check=False)
    assert "RecipeError" in done.stderr and "stands for more than" in done.stderr


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "large", "latin-1", "missing"])
def test_what_is_no_text_file_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path = Path("/dev/zero")
        case "folder":
            path.mkdir()
        case "large":
            with path.open("wb") as file:
                file.truncate(MAX_BYTES + 1)
        case "latin-1":
            path.write_bytes("name: Prägeteil\n".encode("latin-1"))
    with pytest.raises(UserError) as error:
        read_document(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_what_people_write_is_read() -> None:
    assert parse_document("", "x") is None
    assert parse_document("# nothing yet\n", "x") is None
    assert parse_document("base: &b {grey: [0.1, 0.9]}\nother: *b\n", "x")["other"] == {"grey": [0.1, 0.9]}
    assert parse_document("base: &b {a: 1}\nother: {<<: *b, c: 2}\n", "x")["other"] == {"a": 1, "c": 2}
    assert parse_document('{"a": 1e-06}', "x") == {"a": 1e-06}


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_bytes("images: 3\n".encode("utf-8-sig"))
    assert load_recipe(path).images == 3


words = st.text("abcäß 019-:#'\"[]{}&*!|>%@,?\n")
values = st.recursive(
    st.none() | st.booleans() | st.integers() | words,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(words, inner, max_size=4),
    max_leaves=20,
)


@given(values)
def test_whatever_yaml_writes_is_read_back(value: object) -> None:
    assert parse_document(yaml.safe_dump(value, allow_unicode=True), "x") == value


@given(st.text())
def test_any_text_is_read_or_refused_in_one_line(text: str) -> None:
    try:
        parse_document(text, "x")
    except UserError as error:
        assert "\n" not in str(error)


def test_values_in_messages_are_short() -> None:
    assert len(shown("x" * 10_000)) < 100
    assert len(shown([[["deep"] * 1000] * 1000])) < 1000
    with pytest.raises(RecipeError) as error:
        load_recipe(None, ["images=" + "9" * 5000])
    assert len(str(error.value)) < 400
