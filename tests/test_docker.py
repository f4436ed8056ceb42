"""The Dockerfile: what it copies, installs and runs exists. It is not built here, where there is no Docker."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
WORDS = {"FROM", "ARG", "RUN", "COPY", "WORKDIR", "ENV", "ENTRYPOINT", "CMD"}


def _instructions() -> list[tuple[str, str]]:
    """Each instruction of the Dockerfile: its word and the rest of its line, continuation lines joined."""
    text = re.sub(r"^#.*\n", "", (ROOT / "Dockerfile").read_text(encoding="utf-8"), flags=re.MULTILINE)
    lines = re.sub(r"\\\n\s*", " ", text).splitlines()
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in lines if line.strip())]


def _project() -> str:
    return (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_it_holds_instructions_alone() -> None:
    words = [word for word, _ in _instructions()]
    assert set(words) <= WORDS
    assert words[0] == "ARG", "BASE stands before FROM, which names it"
    assert words[-1] == "CMD"
    assert ("FROM", "${BASE}") in _instructions()


def test_it_installs_the_libraries_that_make_installs() -> None:
    (of_make,) = re.findall(r"apt-get install -y --no-install-recommends (.*)", (ROOT / "Makefile").read_text())
    (apt,) = [rest for word, rest in _instructions() if word == "RUN" and "apt-get" in rest]
    assert set(of_make.split()) <= set(apt.split())
    assert {"python3.11", "python3.11-venv"} <= set(apt.split())


def test_what_it_installs_and_runs_is_the_project_s() -> None:
    (pip,) = [rest for word, rest in _instructions() if word == "RUN" and "pip install" in rest]
    (extras,) = re.findall(r"'\.\[(.*)\]'", pip)
    assert all(re.search(rf"^{extra} = \[", _project(), re.MULTILINE) for extra in extras.split(","))
    (program,) = [rest for word, rest in _instructions() if word == "ENTRYPOINT"]
    assert re.search(rf'^{program.strip("[]").strip(chr(34))} = "synthetless', _project(), re.MULTILINE)


def test_all_that_the_wheel_is_built_from_is_copied() -> None:
    """`.dockerignore` leaves everything out but what it names."""
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert "*" in lines
    kept = [line[1:] for line in lines if line.startswith("!")]
    (wheel,) = re.findall(r"wheel\]\nonly-include = (\[.*\])", _project())
    needed = {*re.findall(r'"(\w+)"', wheel), "pyproject.toml", "constraints.txt", "README.md", "LICENSE"}
    assert needed == {name for name in needed if any(fnmatch(name, pattern) for pattern in kept)}
    assert all((ROOT / name).exists() for name in kept)


def test_hadolint_has_nothing_to_say() -> None:
    program = shutil.which("hadolint") or shutil.which(str(Path(sys.executable).parent / "hadolint"))
    if program is None:
        pytest.skip("hadolint is not installed; extra 'dev' has it")
    done = subprocess.run([program, "Dockerfile"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")
