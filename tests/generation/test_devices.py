"""What is rendered on: the choice among devices, and what a machine without them says."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from synthetless.generation import devices
from synthetless.generation.devices import CPU, Devices, best, take
from synthetless.io.files import claim
from synthetless.scenes.blender import RenderDevice

ROOT = Path(__file__).resolve().parents[2]


def _python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )


def test_auto_takes_the_best() -> None:
    assert best(["CPU"], "auto") == CPU
    assert best([], "auto") == CPU
    assert best(["CPU", "CUDA", "CUDA", "OPTIX", "OPTIX"], "auto") == Devices("optix", 2)
    assert best(["HIP", "CPU"], "auto") == Devices("hip", 1)
    assert best(["METAL", "CPU"], "auto") == Devices("metal", 1)


def test_what_is_wished_for_is_taken_or_refused() -> None:
    seen = ["CPU", "CUDA", "CUDA", "CUDA", "OPTIX"]
    assert best(seen, "cuda") == Devices("cuda", 3)
    assert best(seen, "cpu") == CPU
    with pytest.raises(ValueError, match=r"--device hip: .* only cpu, optix, cuda"):
        best(seen, "hip")


def test_the_processor_is_taken_without_asking_blender(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "ask", lambda _: pytest.fail("asked"))
    assert devices.choose("cpu") == CPU


def test_workers_of_one_machine_take_different_gpus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also when one has died and another comes; a number is free again as soon as its process is gone."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert [claim("optix") for _ in range(3)] == [0, 1, 2]
    assert claim("cuda") == 0
    code = "from synthetless.io.files import claim; print(claim('optix'))"
    for _ in range(2):
        assert _python(code, TMPDIR=str(tmp_path)).stdout.strip() == "3"
    assert take(Devices("optix", 3)) == RenderDevice("optix", 0)  # the fourth worker shares with the first
    assert take(CPU) == RenderDevice()


@pytest.mark.blender
def test_a_device_that_is_not_there_is_refused() -> None:
    absent = "optix" if sys.platform == "darwin" else "metal"
    with pytest.raises(ValueError, match=f"--device {absent}: Blender sees no such device here, only "):
        devices.choose(absent)
    done = _python(f"from synthetless.scenes.blender import *; start(1, RenderDevice({absent!r}))")
    assert done.returncode == 1
    assert f"this Blender cannot render with {absent}" in done.stderr


@pytest.mark.blender
@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="only Linux tells a process its cores")
def test_one_thread_is_one_thread_for_all_that_computes(tmp_path: Path) -> None:
    code = f"""
import os
from pathlib import Path
import cv2, numpy, scipy.linalg, threadpoolctl
from synthetless.scenes import blender
cores = os.sched_getaffinity(0)
bpy = blender.start(1)
blas = [library for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"]
assert blas and all(library["num_threads"] == 1 for library in blas), blas
assert cv2.getNumThreads() == 1
assert all(os.sched_getaffinity(int(thread)) == cores for thread in os.listdir("/proc/self/task"))
scene = bpy.context.scene
scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, True
scene.render.resolution_x = scene.render.resolution_y = 32
scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(scene.camera)
scene.render.filepath = {str(tmp_path / "image.png")!r}
bpy.ops.render.render(write_still=True)
"""
    done = _python(code, OIDN_VERBOSE="2")
    assert done.returncode == 0, done.stderr
    assert "Threads : 1" in " ".join(done.stdout.split())


@pytest.mark.blender
@pytest.mark.parametrize("since", ["", "sys.path[:] = before; blender.start(1)"], ids=["once", "path restored between"])
def test_a_process_that_has_blender_can_spawn_others(since: str, tmp_path: Path) -> None:
    """Blender's own folders hold an inner package bpy, which must not come first for the spawned."""
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\n"
        "from multiprocessing import get_context\n"
        "from synthetless.scenes import blender\n"
        "def version(): return blender.start(1).app.version_string\n"
        "if __name__ == '__main__':\n"
        "    before = list(sys.path)\n"
        "    blender.start(1)\n"
        f"    {since}\n"
        "    with get_context('spawn').Pool(1) as pool: print(pool.apply(version))\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().startswith("4.")
