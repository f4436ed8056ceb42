"""The hints on how to install what is missing: they name what works where this package came from."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from synthetless import extras
from synthetless.cli.app import main
from synthetless.extras import LazyModule, MissingExtraError

ROOT = Path(__file__).resolve().parents[1]


def _came_from(url: str | None, monkeypatch: pytest.MonkeyPatch, **record: object) -> None:
    text = None if url is None else json.dumps({"url": url, **record})
    monkeypatch.setattr("importlib.metadata.distribution", lambda _: SimpleNamespace(read_text=lambda _: text))


def test_the_command_names_the_clone_the_wheel_or_the_index(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    wheel = tmp_path / "a folder" / "synthetless-0.1.0-py3-none-any.whl"
    wheel.parent.mkdir()
    wheel.touch()
    _came_from(wheel.as_uri(), monkeypatch, archive_info={})
    assert extras.command("images") == f"pip install '{wheel}[images]'"
    _came_from(tmp_path.as_uri(), monkeypatch, dir_info={"editable": True})
    assert extras.command("ray") == f"pip install -e '{tmp_path}[ray]'"
    wheel.unlink()
    for url in (wheel.as_uri(), "https://example.org/x.whl", None):  # it is gone; or is elsewhere
        _came_from(url, monkeypatch)
        assert extras.command("ray") == f"pip install -e '{ROOT}[ray]'", "this is a clone"
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "site-packages" / "synthetless" / "extras.py"))
    assert extras.command("ray") == "pip install 'synthetless[ray]'"


def test_blender_asks_for_its_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 13, 0, "final", 0))
    told = str(MissingExtraError("bpy"))
    assert told.startswith("Blender is not installed; it is built for Python 3.11 and this is 3.13: ")
    assert told.endswith("[blender]'")
    assert str(MissingExtraError("jinja2")).startswith("jinja2 is not installed; run: pip install ")


def test_a_lazy_module_is_that_module() -> None:
    lazy = LazyModule("wave")
    sys.modules.pop("wave", None)
    assert lazy.open is __import__("wave").open
    assert lazy.open is vars(lazy)["open"], "is found at once the next time"
    with pytest.raises(AttributeError):
        _ = lazy.nothing
    with pytest.raises(KeyError):  # no extra brings it: a fault of ours
        _ = LazyModule("no_such_package").name


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [
        (["generate", "demo", "--out", "d"], "bpy", "blender"),
        (["render", "d", "1", "0", "--to", "x.png"], "bpy", "blender"),
        (["preview", "d"], "jinja2", "preview"),
        (["preview", "d"], "matplotlib", "preview"),
        (["train", "learning/demo", "--data", "d", "--out", "r"], "torch", "learn"),
    ],
)
def test_a_command_without_its_extra_is_one_line(
    command: list[str],
    module: str,
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(sys, "argv", ["synthetless", *command])
    with pytest.raises(SystemExit) as stop:
        main()
    (line,) = capfd.readouterr().err.splitlines()
    assert stop.value.code == 2
    assert line.startswith("synthetless: ")
    assert line.endswith(f"[{extra}]'")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("small_scene_folders")
def test_a_dataset_is_checked_without_looking_at_its_pictures(
    valid: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its records and labels are; what is not is told, and --deep is refused."""
    monkeypatch.setitem(sys.modules, "embreex", None)
    monkeypatch.setattr("synthetless.io.parallel.usable_cores", lambda: 1)  # other processes would have it
    for options, code in ((["--json"], 0), (["--deep"], 2)):
        monkeypatch.setattr(sys, "argv", ["synthetless", "validate", str(valid), *options])
        try:
            main()
            ended = 0
        except SystemExit as stop:
            ended = int(stop.code or 0)
        assert ended == code
    out, err = capfd.readouterr()
    report = json.loads(out)
    assert (report["valid"], report["images"], report["recomputed_images"]) == (True, 6, 0)
    assert any("masks were not looked at; for that, run: pip install" in note for note in report["notes"])
    assert err.splitlines()[-1].startswith("synthetless: embreex is not installed; run: pip install ")
