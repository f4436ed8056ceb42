"""Making datasets from Python: ``from synthetless import ...``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import synthetless
from synthetless import Recipe, UserError, generate, load_recipe

SCRIPT = """
import json
from dataclasses import asdict

from synthetless import Dataset, generate, load_recipe

print("the script runs")
told = []
small = {
    "images": 2, "camera.width": 64, "camera.height": 48, "render.samples": 1, "objects.count": [1, 2]
}
summary = generate(load_recipe("demo", small), "made", workers=1, device="cpu", progress=told.append)
assert [len(image.instances) for image in Dataset.open("made")]
print(json.dumps([asdict(summary), told[0].phase, told[-1].phase, told[-1].share]))
"""


@pytest.mark.blender
def test_a_script_needs_no_guard(tmp_path: Path) -> None:
    """Worker processes do not import it, without ``if __name__ == "__main__"`` either; and it is told what is done."""
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    head, answer = done.stdout.splitlines()
    assert head == "the script runs"
    summary, first, last, share = json.loads(answer)
    assert (summary["images"], summary["made"], summary["failures"]) == (2, 2, [])
    assert (first, last, share) == ("reading models", "done", 1.0)


def test_a_recipe_is_loaded_and_changed(tmp_path: Path) -> None:
    recipe = load_recipe("demo", {"images": 8, "camera.distance_m": (0.5, 0.6), "labels.scheme": "atlas"})
    assert (recipe.images, recipe.camera.distance_m, recipe.labels.scheme) == (8, (0.5, 0.6), "atlas")
    assert recipe.objects == load_recipe("demo").objects
    (tmp_path / "mine.yaml").write_text("images: 3\n")
    assert load_recipe(tmp_path / "mine.yaml") == Recipe(images=3)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"imges": 3}, "did you mean images"),
        ({"images": 0}, "images = 0"),
        ({"images": {1, 2}}, "images = {1, 2}: expected"),
        ({"camera.distance_m": [2, 1]}, "min 2"),
    ],
)
def test_a_wrong_setting_is_told(changes: dict[str, object], told: str) -> None:
    with pytest.raises(UserError, match=told):
        load_recipe("demo", changes)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"workers": 0}, "workers is 0"),
        ({"threads": -1}, "threads is -1"),
        ({"drop_limit_s": 0.0}, "drop_limit_s is 0"),
        ({"device": "metl"}, "metl"),
    ],
)
def test_a_wrong_request_is_told_and_leaves_nothing(options: dict[str, object], told: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=told):
        generate("demo", tmp_path / "d", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "d").exists()


def test_the_names_of_the_package_are_loaded_when_they_are_asked_for() -> None:
    assert set(synthetless.__all__) <= set(dir(synthetless))
    with pytest.raises(AttributeError, match="has no attribute 'generat'"):
        _ = synthetless.generat  # type: ignore[attr-defined]
    code = "import sys, synthetless; assert not {'numpy', 'pydantic', 'typer'} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)
    for name in synthetless.__all__:
        assert getattr(synthetless, name).__doc__
