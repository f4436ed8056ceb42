"""Runs the scripts of bop_toolkit (https://github.com/thodan/bop_toolkit) on a copy of a dataset.

The toolkit is on no package index: the tests run where SYNTHETLESS_BOP_TOOLKIT names a checkout. Its scripts run with
the checkout's .venv/bin/python if there is one, and else with the tests' own; that needs vispy, PyOpenGL, pypng, pytz,
imageio, scikit-image, matplotlib, webdataset and Mesa's EGL (libegl1, libgl1-mesa-dri), which renders without a screen.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from synthetless.config import SPLIT

CHECKOUT = "SYNTHETLESS_BOP_TOOLKIT"
NAME, SPLIT_NAME, SPLIT_TYPE = "tless", *SPLIT.split("_")
"""The toolkit knows train_synthetless of tless: 400x400 pixels, objects 1 to 30, scene folder 000001."""


@dataclass(frozen=True)
class Toolkit:
    """A checkout, and the folder that its scripts take for the one with all BOP datasets."""

    checkout: Path
    python: Path
    folder: Path

    @classmethod
    def find(cls, folder: Path) -> Toolkit:
        """The checkout; skips the test if there is none, or if it cannot render here."""
        checkout = Path(os.environ.get(CHECKOUT, "nowhere"))
        if not (checkout / "scripts" / "calc_gt_masks.py").is_file():
            pytest.skip(f"no bop_toolkit: set {CHECKOUT} to a checkout of https://github.com/thodan/bop_toolkit")
        own = checkout.absolute() / ".venv" / "bin" / "python"
        toolkit = cls(checkout.absolute(), own if own.exists() else Path(sys.executable), folder)
        done = toolkit._call("-c", "from bop_toolkit_lib.rendering import renderer_vispy")
        if done.returncode:
            pytest.skip(f"bop_toolkit cannot render here: {done.stderr.strip().splitlines()[-1]}")
        return toolkit

    @property
    def root(self) -> Path:
        """The dataset's copy."""
        return self.folder / NAME

    def take(self, dataset: Path) -> None:
        """Copy a dataset to where the toolkit looks for T-LESS.

        The toolkit's renderers have the centre of pixel (i, j) at (i + 0.5, j + 0.5), where OpenCV, the rest of the
        toolkit and our labels have it at (i, j). The copy's principal point makes up for that.
        """
        shutil.rmtree(self.root, ignore_errors=True)
        shutil.copytree(dataset, self.root)
        for name in ("models_cad", "models_eval"):
            (self.root / name).symlink_to("models")
        for path in self.root.glob("*/*/scene_camera.json"):
            cameras = json.loads(path.read_text())
            for camera in cameras.values():
                camera["cam_K"][2] += 0.5
                camera["cam_K"][5] += 0.5
            path.write_text(json.dumps(cameras))
        (self.root / "test_targets_bop19.json").write_text("[]")

    def script(self, name: str, *arguments: str, **parameters: Any) -> None:
        """Run a script; ``parameters`` are those at its top, which it is meant to be edited for."""
        text = (self.checkout / "scripts" / name).read_text()
        for key, value in parameters.items():
            text, found = re.subn(rf'^    "{key}": .*$', f'    "{key}": {value!r},', text, count=1, flags=re.MULTILINE)
            assert found, f"{name} has no parameter {key}"
        path = self.folder / "scripts" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        done = self._call(str(path), *arguments)
        assert done.returncode == 0, f"{name}: {done.stdout[-1000:]}{done.stderr[-3000:]}"

    def answer(self, code: str) -> Any:
        """What a piece of Python prints, as JSON."""
        done = self._call("-c", code)
        assert done.returncode == 0, done.stderr[-3000:]
        return json.loads(done.stdout)

    def _call(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environment = {
            "PYTHONPATH": str(self.checkout),
            "BOP_PATH": str(self.folder),
            "BOP_RESULTS_PATH": str(self.folder / "results"),
            "BOP_EVAL_PATH": str(self.folder / "eval"),
            "BOP_OUTPUT_PATH": str(self.folder / "output"),
            "BOP_NUM_WORKERS": "1",
            "EGL_PLATFORM": "surfaceless",
            "LIBGL_ALWAYS_SOFTWARE": "1",
        }
        return subprocess.run(
            [str(self.python), *arguments],
            cwd=self.folder,
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=False,
        )
