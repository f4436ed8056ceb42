"""Processor time until a command answers and a models folder is open: ``python -m benchmarks.startup [MODELS_DIR]``.

Without a folder it takes the one that SYNTHETLESS_TLESS_MODELS names, or else the parts that come with the project.
Each thing is done in a process of its own, several times, and the fastest counts. ``--checkout`` measures another
checkout of the project with this Python, to compare the two. Prints a table and writes
benchmarks/results/startup.json.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks import ROOT, default_models, keep

COMMAND = (
    *(sys.executable, "-c"),
    "import sys; sys.argv[0] = 'synthetless'; from synthetless.cli.app import main; main()",
)
COMPLETION = {
    "_SYNTHETLESS_COMPLETE": "complete_bash",
    "COMP_WORDS": "synthetless generate --im",
    "COMP_CWORD": "2",
}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path, nargs="?", default=default_models())
    parser.add_argument("--checkout", type=Path, default=ROOT, help="of the project; default: this one")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    importing = "import sys; from pathlib import Path; from synthetless.io.models import load_models"
    opening = f"{importing}; load_models(Path(sys.argv[1]))"
    environment = {**os.environ, "PYTHONPATH": str(arguments.checkout / "src")}
    runs: dict[str, tuple[Sequence[str], Mapping[str, str]]] = {
        "python alone": ((sys.executable, "-c", ""), {}),
        "--help": ((*COMMAND, "--help"), {}),
        "--version": ((*COMMAND, "--version"), {}),
        "completion": (COMMAND, COMPLETION),
        "usage error": ((*COMMAND, "generate", "--imagse", "3"), {}),
        "generate --help": ((*COMMAND, "generate", "--help"), {}),
        "import of the mesh reader": ((sys.executable, "-c", importing), {}),
        f"{arguments.models} opened": ((sys.executable, "-c", opening, str(arguments.models.resolve())), {}),
    }
    result = {}
    for name, (command, extra) in runs.items():
        result[name] = min(cpu_s(command, {**environment, **extra}) for _ in range(arguments.repeats))
        print(f"{result[name]:7.3f} s  {name}")
    keep("startup", result)


def cpu_s(command: Sequence[str], environment: Mapping[str, str]) -> float:
    """User and system time of a command and its children, s; how it ends does not matter."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, env=environment, cwd="/", capture_output=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
