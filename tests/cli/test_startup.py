"""What the command imports before it knows what to do."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping

import pytest

HEAVY = {"numpy", "scipy", "trimesh", "cv2", "PIL", "matplotlib", "yaml", "tqdm", "rich", "bpy"}
COMMAND = "import sys; sys.argv[0] = 'synthetless'; from synthetless.cli.app import main; main()"
COMPLETION = {
    "_SYNTHETLESS_COMPLETE": "complete_bash",
    "COMP_WORDS": "synthetless generate --im",
    "COMP_CWORD": "2",
}


@pytest.mark.parametrize(
    ("arguments", "environment", "answer", "forbidden"),
    [
        (["--help"], {}, "symmetries", HEAVY | {"pydantic"}),
        (["--version"], {}, "synthetless", HEAVY | {"pydantic"}),
        (["symmetries", "--help"], {}, "detect", HEAVY),
        (["relabel", "--help"], {}, "pitteri2019", HEAVY),
        (["generate", "--imagse", "3"], {}, "--images", HEAVY),
        (["generate", "recipe.yaml", "--out", "out", "--images", "many"], {}, "--images", HEAVY),
        (["frobnicate"], {}, "frobnicate", HEAVY),
        ([], COMPLETION, "--images", HEAVY),
    ],
)
def test_nothing_heavy_is_imported_to_answer(
    arguments: list[str], environment: Mapping[str, str], answer: str, forbidden: set[str]
) -> None:
    """Not timed: the imports are what took more than a second."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", COMMAND, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    imports = [line.rpartition("|")[2].strip() for line in done.stderr.splitlines() if line.startswith("import time:")]
    assert "typer" in imports, done.stderr
    assert answer in done.stdout + done.stderr
    assert not forbidden & {name.partition(".")[0] for name in imports}
