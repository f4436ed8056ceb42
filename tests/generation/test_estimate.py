"""What a dataset would take: told before anything is made, and nothing is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from synthetless.generation.estimate import Estimate

pytestmark = pytest.mark.blender

ROOT = Path(__file__).resolve().parents[2]
SMALL = ["camera.width=64", "camera.height=48", "render.samples=1", "objects.count=[1, 2]", "camera.views_per_drop=3"]


def _generate(out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    sets = [word for setting in SMALL for word in ("--set", setting)]
    command = [sys.executable, "-m", "synthetless", "generate", "configs/demo.yaml", "--out", str(out), *sets, *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)


def test_a_dry_run_tells_and_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "d"
    done = _generate(out, "--images", "2500", "--workers", "2", "--dry-run", "--json")
    assert done.returncode == 0, done.stderr
    plan = json.loads(done.stdout)
    assert not out.exists()
    assert (plan["images"], plan["drops"], plan["existing"], plan["scene_folders"]) == (2500, 834, 0, 3)
    assert plan["device"] == "cpu"
    assert plan["hours"] == pytest.approx(2500 * plan["seconds_per_image"] / 2 / 3600)
    assert plan["disk_bytes"] > 2500 * plan["bytes_per_image"] > 2500 * 100
    assert plan["seconds_per_image"] > 0


def test_a_dry_run_counts_what_is_missing(tmp_path: Path) -> None:
    out = tmp_path / "d"
    assert _generate(out, "--images", "3").returncode == 0
    before = sorted(out.rglob("*"))
    done = _generate(out, "--images", "7", "--dry-run")
    assert done.returncode == 0, done.stderr
    assert "4 to make in 2 drops of 3 views each; 3 are there already" in done.stdout
    assert sorted(out.rglob("*")) == before
    fewer = _generate(out, "--images", "2", "--dry-run", "--json")
    assert [json.loads(fewer.stdout)[key] for key in ("images", "existing", "hours")] == [0, 3, 0]
    other = _generate(out, "--seed", "5", "--dry-run")
    assert other.returncode == 2
    assert "seed" in other.stderr


def test_too_little_disk_is_said() -> None:
    plan = Estimate(10, 10, 0, 1, 1, "cpu", 2, 1.0, 0.1, 1000, 10_000, 9_000)
    assert "NOT ENOUGH" in str(plan)
    assert "about 6 min" in str(plan)
