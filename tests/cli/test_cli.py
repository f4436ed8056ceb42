"""The command line: what a wrong request is answered with, and that it leaves nothing behind."""

from __future__ import annotations

import inspect
import json
import shutil
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synthetless.cli.app import main
from synthetless.config import load_recipe
from synthetless.errors import UserError

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Run the command in this process; returns its exit code, stdout and stderr."""

    def invoke(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["synthetless", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        printed = capfd.readouterr()
        return code, printed.out, printed.err

    return invoke


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    """A folder with a small recipe, one model and one photograph, all good."""
    models, photos = tmp_path / "in" / "models", tmp_path / "in" / "photos"
    models.mkdir(parents=True)
    photos.mkdir()
    trimesh.creation.box((30, 20, 10)).export(models / "obj_000001.ply")
    info = {"diameter": float(np.sqrt(1400))}
    for axis, side in zip("xyz", (30.0, 20.0, 10.0), strict=True):
        info |= {f"min_{axis}": -side / 2, f"size_{axis}": side}
    (models / "models_info.json").write_text(json.dumps({"1": info}))
    cv2.imwrite(str(photos / "wall.jpg"), np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8))
    (tmp_path / "in" / "recipe.yaml").write_text("images: 1\nobjects: {count: [1, 1]}\n")
    return tmp_path / "in"


def _reflection(inputs: Path) -> None:
    path = inputs / "models" / "models_info.json"
    infos = json.loads(path.read_text())
    infos["1"]["symmetries_discrete"] = [[-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]
    path.write_text(json.dumps(infos))


def _nan_vertex(inputs: Path) -> None:
    box = trimesh.creation.box((30, 20, 10))
    vertices = np.array(box.vertices)
    vertices[3, 1] = np.nan
    trimesh.Trimesh(vertices, box.faces, process=False).export(inputs / "models" / "obj_000001.ply")


def _without_faces(inputs: Path) -> None:
    trimesh.PointCloud(trimesh.creation.box((30, 20, 10)).vertices).export(inputs / "models" / "obj_000001.ply")


def _ball(inputs: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=10)
    ball.export(inputs / "models" / "obj_000001.ply")
    (inputs / "models" / "models_info.json").write_text(json.dumps({"1": {"diameter": 20.0}}))


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


BAD_INPUT: dict[str, tuple[Callable[[Path], object], list[str], list[str]]] = {
    "no models folder": (lambda i: shutil.rmtree(i / "models"), [], ["models", "no such models folder"]),
    "empty models folder": (
        lambda i: [path.unlink() for path in (i / "models").iterdir()],
        [],
        ["models", "holds no models", "obj_000001.ply"],
    ),
    "broken ply": (lambda i: _truncate(i / "models" / "obj_000001.ply"), [], ["obj_000001.ply"]),
    "mesh without faces": (_without_faces, [], ["obj_000001.ply", "no faces"]),
    "nan vertices": (_nan_vertex, [], ["obj_000001.ply", "vertex 3", "nan"]),
    "info lacks an object": (
        lambda i: (i / "models" / "models_info.json").write_text("{}"),
        [],
        ["models_info.json", "no entry for object 1"],
    ),
    "symmetry is a reflection": (_reflection, [], ["models_info.json", "object 1"]),
    "unreadable texture": (lambda i: _truncate(i / "photos" / "wall.jpg"), [], ["wall.jpg"]),
    "empty texture": (lambda i: (i / "photos" / "wall.jpg").write_bytes(b""), [], ["wall.jpg"]),
    "no textures": (lambda i: (i / "photos" / "wall.jpg").unlink(), [], ["photos"]),
    "recipe typo": (
        lambda i: (i / "recipe.yaml").write_text("camera: {distence_m: [1, 2]}\n"),
        [],
        ["recipe.yaml", "camera.distence_m", "did you mean camera.distance_m"],
    ),
    "min above max": (
        lambda i: (i / "recipe.yaml").write_text("camera: {distance_m: [2, 1]}\n"),
        [],
        ["recipe.yaml", "camera.distance_m", "min 2", "max 1"],
    ),
    "no recipe": (lambda i: (i / "recipe.yaml").unlink(), [], ["recipe.yaml", "no such recipe"]),
    "unknown object": (lambda i: None, ["--set", "objects.ids=[7]"], ["no mesh for object 7"]),
    "no distractors": (
        lambda i: None,
        ["--set", "objects.distractors=[1, 2]"],
        ["objects.distractors", "source.distractors"],
    ),
    "sides too small": (
        lambda i: None,
        ["--set", "release.container=box", "--set", "release.container.box.sides_m=[0.03, 0.2]"],
        ["release.container.box.sides_m = [0.03, 0.2]", "obj_000001.ply", "37 mm", "give at least 0.038"],
    ),
    "sides thinner than what counts as visible": (
        lambda i: None,
        ["--set", "release.container=tray", "--set", "release.container.tray.wall_m=[0.002, 0.01]"],
        ["release.container.tray.wall_m", "labels.visibility_delta_mm = 5", "1.6 mm"],
    ),
    "upright without a face to stand on": (
        _ball,
        ["--set", "release.upright=0.5"],
        ["release.upright", "obj_000001.ply", "no stable face", "objects.ids"],
    ),
    "no images": (lambda i: None, ["--images", "0"], ["images", "0"]),
    "no such option": (lambda i: None, ["--imagse", "3"], ["--imagse", "--images"]),
}


@pytest.mark.parametrize("kind", BAD_INPUT)
def test_bad_input_is_one_line_and_leaves_nothing(kind: str, inputs: Path, tmp_path: Path, run: Run) -> None:
    damage, options, expected = BAD_INPUT[kind]
    damage(inputs)
    out = tmp_path / "out"
    sources = ["--models", inputs / "models", "--textures", inputs / "photos"]
    code, stdout, stderr = run("generate", inputs / "recipe.yaml", "--out", out, *sources, *options)
    assert code == 2
    assert stdout == ""
    assert "Traceback" not in stderr
    last = stderr.strip().splitlines()[-1]
    for part in expected:
        assert part in last, last
    assert not out.exists()


def test_a_foreign_folder_is_left_alone(inputs: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("dear")
    code, _, stderr = run("generate", inputs / "recipe.yaml", "--out", out, "--models", inputs / "models")
    assert code == 2
    assert "thesis.tex" in stderr
    assert [path.name for path in out.iterdir()] == ["thesis.tex"]


def test_an_unwritable_folder_is_told(inputs: Path, tmp_path: Path, run: Run) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file" / "out", Path("/proc/nothing")):
        code, _, stderr = run("generate", inputs / "recipe.yaml", "--out", out, "--models", inputs / "models")
        assert code == 2
        assert str(out) in stderr
        assert "Traceback" not in stderr


def test_help_lists_every_setting(run: Run) -> None:
    from synthetless.config import settings

    code, stdout, _ = run("generate", "--help-settings")
    assert code == 0
    for setting in settings():
        assert f"{setting.key}=" in stdout
    assert max(map(len, stdout.splitlines())) <= 80


def test_the_help_of_generate_fits_two_screens(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    code, stdout, _ = run("generate", "--help")
    assert code == 0
    assert len(stdout.splitlines()) <= 2 * 24
    assert "--help-settings" in stdout


def test_the_help_of_a_source_is_about_that_source(run: Run) -> None:
    for source, title in (("tless", "T-LESS"), ("dtd", "Describable Textures")):
        code, stdout, _ = run("fetch", source, "--help")
        assert code == 0
        assert title in stdout
        assert "--from" in stdout


@pytest.mark.parametrize(
    "command",
    [
        ("symmetries", "detect", "models", "--scale"),
        ("symmetries", "detect", "models", "--tolerance-percent"),
        ("ambiguity", "dataset", "--eps-mm"),
        ("compare", "--out", "page", "--margin-weight"),
    ],
)
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf"])
def test_what_cannot_be_0_is_refused(command: tuple[str, ...], value: str, run: Run) -> None:
    told = f"synthetless: {command[-1]} is {value}; a number above 0 is needed\n"
    assert run(*command, value) == (2, "", told)


def test_every_command_that_answers_has_json() -> None:
    from synthetless.cli import commands

    apps = [commands.app, commands.fetch, commands.export, commands.symmetries]
    without = [
        command.name
        for each in apps
        for command in each.registered_commands
        if command.callback and "as_json" not in inspect.signature(command.callback).parameters
    ]
    assert without == []


def test_answers_in_json(run: Run, valid: Path, tmp_path: Path) -> None:
    """Those that need neither Blender nor long."""
    code, stdout, _ = run("export", "coco", valid, "--to", tmp_path / "coco.json", "--json")
    assert (code, json.loads(stdout)) == (0, {"images": 6, "file": str(tmp_path / "coco.json")})
    code, stdout, _ = run("export", "webdataset", valid, "--to", tmp_path / "shards", "--json")
    assert (code, json.loads(stdout)) == (0, {"images": 6, "shards": 1, "folder": str(tmp_path / "shards")})
    code, stdout, _ = run("symmetries", "show", valid, "--json")
    shown = json.loads(stdout)
    assert code == 0
    assert shown["objects"].keys() == shown["table"]["objects"].keys()
    assert all(entry["n_regressors"]["atlas"] >= 1 for entry in shown["objects"].values())


def test_recipes_are_listed_and_copied(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    code, stdout, _ = run("recipes")
    assert code == 0
    assert {"demo", "synthetless", "tless_bop", "learning/demo"} <= {line.split()[0] for line in stdout.splitlines()}
    assert all(len(line.split()) > 3 for line in stdout.splitlines()), "each with what it makes"
    assert run("recipes", "--copy", "demo")[:2] == (0, "recipe: demo.yaml\n")
    assert load_recipe(tmp_path / "demo.yaml") == load_recipe(Path("demo"))
    code, _, stderr = run("recipes", "--copy", "demo")
    assert code == 2
    assert "demo.yaml: exists already" in stderr
    code, _, stderr = run("recipes", "--copy", "dmeo", "--to", "new.yaml")
    assert code == 2
    assert "--copy dmeo: no such recipe" in stderr
    assert run("recipes", "--to", "new.yaml")[0] == 2
    assert [path.name for path in tmp_path.iterdir()] == ["demo.yaml"]


def test_a_recipe_is_found_by_its_name_or_its_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder of the same name is no recipe; a file is."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    assert load_recipe(Path("demo")).name == "synthetless_demo"
    (tmp_path / "synthetless").write_text("name: mine\n")
    assert load_recipe(Path("synthetless")).name == "mine"
    with pytest.raises(UserError, match=r"^tless_bp: no such recipe file; did you mean tless_bop\?$"):
        load_recipe(Path("tless_bp"))


def test_without_arguments_the_commands_are_listed(run: Run) -> None:
    _, stdout, stderr = run()
    assert "generate" in stdout + stderr
    assert "render" in stdout + stderr


def test_no_summary_of_a_command_is_cut(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for group in ([], ["export"], ["symmetries"], ["fetch"]):
        code, out, _ = run(*group, "--help")
        assert code == 0
        commands = out.partition("Commands:")[2].splitlines()
        assert len(commands) >= 2
        assert not [line for line in commands if line.rstrip().endswith(("...", "…"))]


def test_help_fits_eighty_columns(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    names = ("generate", "recipes", "preview", "validate", "relabel", "adopt", "doctor", "render", "redo", "redevelop")
    for command in names:
        _, out, _ = run(command, "--help")
        assert max(map(len, out.splitlines())) <= 80


def test_the_version_is_told(run: Run) -> None:
    assert run("--version")[:2] == (0, f"synthetless {version('synthetless')}\n")


def test_requests_that_contradict_themselves(run: Run, inputs: Path, tmp_path: Path) -> None:
    begin = ("generate", inputs / "recipe.yaml", "--models", inputs / "models", "--out", tmp_path / "out")
    for options, expected in (
        (["--address", "auto"], "--executor ray"),
        (["--executor", "ray", "--dry-run"], "--dry-run"),
        (["--device", "metal"], "--device metal"),
        (["--part", "3/2"], "3/2"),
    ):
        code, _, err = run(*begin, *options)
        assert code == 2
        assert expected in err.splitlines()[-1]
        assert "Traceback" not in err
    assert not (tmp_path / "out").exists()
