"""Measurements, each a script: ``python -m benchmarks.NAME``. Here is what several of them begin and end with."""

from __future__ import annotations

import argparse
import json
import os
import resource
from pathlib import Path
from typing import Any

from synthetless.config import Recipe, load_recipe

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"


def parser(description: str | None) -> argparse.ArgumentParser:
    """A parser of arguments that knows where models and photographs are."""
    arguments = argparse.ArgumentParser(description=description)
    arguments.add_argument("--models", default="builtin", help="BOP models folder")
    arguments.add_argument("--textures", default="builtin", help="folder of photographs")
    return arguments


def default_models() -> Path:
    """The folder that SYNTHETLESS_TLESS_MODELS names, or else the parts that come with the project."""
    return Path(os.environ.get("SYNTHETLESS_TLESS_MODELS", ROOT / "assets" / "parts"))


def tless_recipe(arguments: argparse.Namespace, *overrides: str) -> Recipe:
    """The T-LESS recipe with 10 objects, of the models and photographs that the arguments name."""
    sources = [f"source.{name}={json.dumps(getattr(arguments, name))}" for name in ("models", "textures")]
    return load_recipe(ROOT / "configs" / "tless_bop.yaml", [*sources, "objects.count=[10, 10]", *overrides])


def keep(name: str, result: Any) -> None:
    """Write what was measured to benchmarks/results/NAME.json."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")


def cpu_s() -> float:
    """CPU seconds of this process so far, and of those that it started and that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
