"""The commands of the learning system: what they print, and one line where something is wrong."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from packages import package_or_skip

from synthetless.config import load_settings
from synthetless.learning.settings import Training, training_page

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_TORCH = (
    "import importlib.util as util\n"
    "found = util.find_spec\n"
    "util.find_spec = lambda name, *more: None if name == 'torch' else found(name, *more)\n"
)


def _call(*arguments: str, before: str = "") -> subprocess.CompletedProcess[str]:
    code = (
        f"{before}import sys\nsys.argv = {['synthetless', *arguments]!r}\nfrom synthetless.cli.app import main\nmain()"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "arguments",
    [("train", "a.yaml", "--data", "b", "--out", "c"), ("predict", "a", "b", "--to", "c"), ("compare", "--out", "c")],
)
def test_without_torch_a_command_says_what_to_install(arguments: tuple[str, ...]) -> None:
    done = _call(*arguments, before=WITHOUT_TORCH)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "torch is not installed; run: pip install " in done.stderr
    assert "[learn]'" in done.stderr


def test_a_wrong_training_is_one_line(tmp_path: Path, valid: Path) -> None:
    package_or_skip("torch", "extra 'learn' has it")
    config = tmp_path / "wrong.yaml"
    for text, said in (
        ("labels: maps\n", "labels = 'maps': input should be 'true', 'map'"),
        ("network: {chanels: 3}\n", "unknown setting network.chanels; did you mean network.channels?"),
        ("schedule: {steps: 0}\n", "schedule.steps = 0: 0 is outside 1..10000000"),
        ("- 1\n", "not a list"),
    ):
        config.write_text(text)
        done = _call("train", str(config), "--data", str(valid), "--out", str(tmp_path / "run"))
        assert done.returncode == 2, done.stdout
        assert said in done.stderr
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_train_predict_and_score_in_a_row(tmp_path: Path, valid: Path) -> None:
    package_or_skip("torch", "extra 'learn' has it")
    config = tmp_path / "tiny.yaml"
    config.write_text("network: {channels: 16, hidden: 32, weights: none}\nschedule: {steps: 1, images_per_step: 1}\n")
    run, results = str(tmp_path / "run"), str(tmp_path / "results.csv")
    done = _call("train", str(config), "--data", str(valid), "--out", run, "--labels", "true", "--device", "cpu")
    assert done.returncode == 0, done.stderr
    assert "step 1 of 1: objectness" in done.stdout
    assert json.loads((tmp_path / "run" / "run.json").read_text())["training"]["labels"] == "true"
    done = _call("predict", run, str(valid), "--to", results, "--device", "cpu")
    assert done.returncode == 0, done.stderr
    done = _call(
        "score", str(valid), results, "--errors", "mspd", "--to", str(tmp_path / "page.html"), "--workers", "1"
    )
    assert done.returncode == 0, done.stderr
    assert "AR MSPD" in done.stdout
    assert "<svg" in (tmp_path / "page.html").read_text()


def test_a_damaged_result_file_is_one_line(tmp_path: Path, valid: Path) -> None:
    (tmp_path / "results.csv").write_text("1,0,1,0.5,1 0 0 0 1 0 0 0 1,0 0,-1\n")
    done = _call("score", str(valid), str(tmp_path / "results.csv"))
    assert done.returncode == 2
    assert done.stderr == f"synthetless: {tmp_path / 'results.csv'}, row 1: t has 2 numbers, not 3\n"


def test_an_unknown_error_is_one_line(tmp_path: Path, valid: Path) -> None:
    done = _call("score", str(valid), str(tmp_path / "results.csv"), "--errors", "adi")
    assert done.returncode == 2
    assert "unknown error 'adi': use vsd, mssd, mspd" in done.stderr


def test_the_settings_page_is_written_from_the_schema() -> None:
    assert (ROOT / "docs" / "learning_settings.md").read_text(encoding="utf-8") == training_page(), "run `make docs`"


@pytest.mark.parametrize("name", ["demo", "tless"])
def test_the_trainings_that_come_with_the_project_are_valid(name: str) -> None:
    training = load_settings(Training, ROOT / "configs" / "learning" / f"{name}.yaml")
    assert training.labels == "atlas"
    assert yaml.safe_load((ROOT / "configs" / "learning" / "demo_data.yaml").read_text())["objects"]["ids"]
