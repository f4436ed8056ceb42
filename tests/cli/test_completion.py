"""Tab completion in a real bash: after `synthetless --install-completion` it offers commands, options and values."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

BASH = shutil.which("bash")
ASK = """
ask() {
    COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
    _synthetless_completion synthetless "${@: -1}"
    echo "${COMPREPLY[*]}"
}
"""

pytestmark = pytest.mark.skipif(BASH is None, reason="bash is not installed")


def _interactive(home: Path, script: str) -> list[str]:
    """What an interactive bash prints, line by line, that starts as a terminal of the user does whose home this is."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        (str(BASH), "-i"),
        input=script,
        env={**os.environ, "HOME": str(home), "PATH": path, "PS1": "", "HISTFILE": ""},
        capture_output=True,
        text=True,
        check=True,
        start_new_session=True,  # or it would take the terminal that the tests run in
    )
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The home of a user who has installed the completion."""
    folder = tmp_path_factory.mktemp("home")
    (folder / ".bashrc").write_text("")
    _interactive(folder, "synthetless --install-completion\n")
    return folder


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("''", {"doctor", "fetch", "generate", "preview", "validate", "relabel", "adopt", "export", "symmetries"}),
        ("gen", {"generate"}),
        ("generate --im", {"--images"}),
        ("generate configs/demo.yaml --dev", {"--device"}),
        ("symmetries ''", {"detect", "show"}),
        ("export ''", {"coco", "webdataset"}),
        ("fetch ''", {"tless", "dtd"}),
        ("generate tless_bo", {"tless_bop"}),
        ("relabel out/demo --scheme ''", {"pitteri2019", "atlas"}),
        ("relabel out/demo --scheme a", {"atlas"}),
    ],
)
def test_what_is_offered(home: Path, words: str, offered: set[str]) -> None:
    (last,) = _interactive(home, f"{ASK}\nask synthetless {words}\n")
    found = set(last.split())
    assert offered <= found
    if not words.endswith("''"):
        assert found == offered


def test_a_new_terminal_knows_it_and_files_are_offered_too(home: Path) -> None:
    (line,) = _interactive(home, "complete -p synthetless\n")
    assert "-F _synthetless_completion" in line
    assert "-o default" in line, "bash offers files where the command has nothing to offer"
