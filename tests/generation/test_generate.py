"""The whole way, as a user goes it: the command, its files, its interruptions. Real physics, real renders, small."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from trees import SHARED_LOCK, data_files

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.scene import scene_caster
from synthetless.config import load_recipe
from synthetless.dataset import records
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.reader import read_recipe, read_specs
from synthetless.generation.executors import FAULT_VARIABLE
from synthetless.generation.generate import Execution, generate
from synthetless.generation.rerender import render_again
from synthetless.io.cache import CACHE_VARIABLE
from synthetless.io.files import read_json
from synthetless.io.models import load_models
from synthetless.scenes.rotations import matrix
from synthetless.scenes.spec import Intrinsics
from synthetless.validation import validate

pytestmark = pytest.mark.blender

ROOT = Path(__file__).resolve().parents[2]
RECIPE = """
images: 6
camera: {width: 96, height: 72, fx: 170, fy: 170, cx: 47.5, cy: 35.5, distance_m: [0.6, 0.9], views_per_drop: 2}
objects: {count: [2, 4]}
render: {samples: 2}
outputs: [rgb, depth, masks, normals, object_coordinates, exr]
"""


@pytest.fixture(scope="session")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recipe") / "small.yaml"
    path.write_text(RECIPE)
    return path


def _command(recipe: Path, out: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "synthetless", "generate", str(recipe), "--out", str(out), *options]


def _generate(recipe: Path, out: Path, *options: str, code: int = 0, **environment: str) -> str:
    return _run(recipe, out, *options, code=code, **environment).stdout


def _run(recipe: Path, out: Path, *options: str, code: int = 0, **environment: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        _command(recipe, out, "--json", *options),
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == code, done.stderr
    return done


@pytest.fixture(scope="session")
def dataset(recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images of three drops of the built-in parts, by one worker."""
    out = tmp_path_factory.mktemp("dataset") / "d"
    summary = json.loads(_generate(recipe, out, "--workers", "1"))
    assert (summary["images"], summary["made"], summary["failures"]) == (6, 6, [])
    return out


def test_every_file_is_there(dataset: Path) -> None:
    scene = ScenePaths.of(dataset, 1)
    gt = records.read_scene_json(scene.scene_gt)
    assert list(gt) == list(range(6))
    for path in (scene.scene_camera, scene.scene_gt_info, scene.scene_gt_canonical):
        content = records.read_scene_json(path)
        assert list(content) == list(gt)
    for im_id, entries in gt.items():
        assert entries, "every drop lies in view"
        for path in (scene.rgb(im_id), scene.depth(im_id), scene.normals(im_id), scene.object_coordinates(im_id)):
            assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape[:2] == (72, 96)
        assert scene.exr(im_id).stat().st_size > 0
        for gt_id in range(len(entries)):
            mask, visible = (cv2.imread(str(p), -1) for p in (scene.mask(im_id, gt_id), scene.mask_visib(im_id, gt_id)))
            assert mask.any(), "nothing outside the view is labelled"
            assert not (visible > mask).any()
    assert (dataset / "preview.jpg").exists()
    assert read_json(dataset / "dataset.json")["counts"]["images"] == 6
    assert set(read_json(dataset / "camera.json")) == {"cx", "cy", "depth_scale", "fx", "fy", "height", "width"}


def test_workers_do_not_change_a_byte_and_tell_what_they_do(dataset: Path, recipe: Path, tmp_path: Path) -> None:
    done = _run(recipe, tmp_path / "d", "--workers", "2", "--json-progress")
    told = [json.loads(line) for line in done.stderr.splitlines()]
    phases = [each["phase"] for each in told]
    assert phases[:3] == ["looking for devices", "reading models", "starting Blender"]
    assert {"dropping objects", "rendering", "making images"} & set(phases)
    assert phases[-2:] == ["writing the dataset's files", "done"]
    assert (told[-1]["images"], told[-1]["wanted"], told[-1]["share"]) == (6, 6, 1.0)
    assert data_files(tmp_path / "d") == data_files(dataset)


def test_parts_do_not_change_a_byte(dataset: Path, recipe: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    parts = [
        subprocess.Popen(
            _command(recipe, out, "--part", f"{k}/2", "--workers", "1"), cwd=ROOT, stderr=subprocess.DEVNULL
        )
        for k in (1, 2)
    ]
    assert [part.wait(timeout=400) for part in parts] == [0, 0]
    assert data_files(out, {SHARED_LOCK}) == data_files(dataset)


def test_the_cache_does_not_change_a_byte(dataset: Path, recipe: Path, tmp_path: Path) -> None:
    """Without it, with a new one, and with one that is damaged."""
    small = ["--images", "2", "--workers", "1"]
    cache = tmp_path / "cache"
    _generate(recipe, tmp_path / "without", *small, "--no-cache", **{CACHE_VARIABLE: str(cache)})
    assert not cache.exists()
    _generate(recipe, tmp_path / "with", *small, **{CACHE_VARIABLE: str(cache)})
    kept = list(cache.rglob("*.npz"))
    assert kept
    for path in kept:
        path.write_bytes(path.read_bytes()[:-1])
    _generate(recipe, tmp_path / "damaged", *small, **{CACHE_VARIABLE: str(cache)})
    without = data_files(tmp_path / "without")
    assert data_files(tmp_path / "with") == without
    assert data_files(tmp_path / "damaged") == without
    assert {name for name in without if "/rgb/" in name} < data_files(dataset).keys()


def test_another_seed_changes_every_image(dataset: Path, recipe: Path, tmp_path: Path) -> None:
    _generate(recipe, tmp_path / "d", "--seed", "1", "--images", "2")
    for im_id in range(2):
        ours, other = (ScenePaths.of(root, 1).rgb(im_id).read_bytes() for root in (dataset, tmp_path / "d"))
        assert ours != other


def test_ctrl_c_and_again_gives_the_same_bytes(dataset: Path, recipe: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    process = subprocess.Popen(
        _command(recipe, out, "--workers", "1"), cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 300
    while not list(out.glob(".records/*/*.json")) and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process of the command
    started = time.monotonic()
    _, stderr = process.communicate(timeout=60)
    assert time.monotonic() - started < 30
    assert process.returncode == 130
    assert "Traceback" not in stderr
    assert stderr.strip().splitlines()[-1] == "synthetless: interrupted; run the same command again to continue"
    made = len(records.read_scene_json(ScenePaths.of(out, 1).scene_camera))
    assert 1 <= made < 6, "what is made can be looked at"
    _generate(recipe, out)
    assert data_files(out) == data_files(dataset)


def test_a_finished_dataset_is_left_as_it_is(dataset: Path, recipe: Path) -> None:
    before = data_files(dataset)
    summary = json.loads(_generate(recipe, dataset))
    assert (summary["images"], summary["made"]) == (6, 0)
    assert data_files(dataset) == before


def test_drops_that_kill_hang_or_never_settle_do_not_stop_the_others(
    dataset: Path, recipe: Path, tmp_path: Path
) -> None:
    out = tmp_path / "d"
    faults = {FAULT_VARIABLE: "abort:0,hang:1,unsettled:3"}
    options = ["--images", "10", "--workers", "2", "--drop-limit", "20"]
    summary = json.loads(_generate(recipe, out, *options, code=1, **faults))
    assert summary["images"] == 4
    told = dict(line.split(": ", 1) for line in summary["failures"])
    assert told.keys() == {"drop 0", "drop 1", "drop 3"}
    assert "worker died" in told["drop 0"]
    assert "20 s" in told["drop 1"]
    assert "did not come to rest" in told["drop 3"]
    assert f"synthetless redo {out} 3" in told["drop 3"]
    note = read_json(out / ".failures" / "00000003.json")
    assert note["scene"]["drop"] == 3
    redone = subprocess.run(
        [sys.executable, "-m", "synthetless", "redo", str(out), "3"],
        cwd=ROOT,
        capture_output=True,
        timeout=300,
        check=True,
    )
    assert b"drop 3: 2 images" in redone.stdout
    assert len(list((out / ".failures").iterdir())) == 2
    _generate(recipe, out, "--images", "6")
    ours = {name: content for name, content in data_files(dataset).items() if "/rgb/" in name}
    again = data_files(out)
    assert {name: again[name] for name in ours} == ours, "a second run makes what the first could not"


def test_an_image_is_rendered_again_from_its_record(dataset: Path, tmp_path: Path) -> None:
    target = tmp_path / "again.png"
    subprocess.run(
        [sys.executable, "-m", "synthetless", "render", str(dataset), "1", "3", "--to", str(target)],
        cwd=ROOT,
        check=True,
        capture_output=True,
        timeout=300,
    )
    np.testing.assert_array_equal(cv2.imread(str(target)), cv2.imread(str(ScenePaths.of(dataset, 1).rgb(3))))


def test_a_drop_into_a_box_is_upright_valid_and_rendered_again(recipe: Path, tmp_path: Path) -> None:
    overrides = ["release.container=box", "release.container.box.sides_m=[0.25, 0.25]", "release.upright=1"]
    overrides += ["objects.ids=[2, 3]", "objects.count=[3, 3]", "camera.elevation_deg=[60, 70]", "images=1"]
    generate(load_recipe(recipe, overrides), tmp_path / "d", Execution(workers=1))
    (image,) = read_specs(ScenePaths.of(tmp_path / "d", 1)).values()
    assert image.scene.container is not None and image.scene.container.kind == "box"
    assert min(matrix(pose.rotation_wxyz)[2, 2] for pose in image.settled) > np.cos(np.radians(3))
    stored = cv2.imread(str(ScenePaths.of(tmp_path / "d", 1).rgb(0)))[..., ::-1]
    np.testing.assert_array_equal(render_again(tmp_path / "d", 1, 0), stored)
    report = validate(tmp_path / "d", workers=1)
    assert report.valid and report.recomputed_images == 1, report.lines()


def test_images_are_neither_black_nor_blown_out_nor_empty(dataset: Path) -> None:
    scene = ScenePaths.of(dataset, 1)
    visible = records.read_scene_json(scene.scene_gt_info)
    for im_id, infos in visible.items():
        pixels = cv2.imread(str(scene.rgb(im_id))).astype(float) / 255
        luminance = pixels @ [0.0722, 0.7152, 0.2126]
        assert 0.05 <= luminance.mean() <= 0.85
        assert luminance.std() > 0.02
        assert max(info["visib_fract"] for info in infos) > 0.5


def test_most_of_what_is_dropped_is_in_the_frame(dataset: Path) -> None:
    recorded = read_specs(ScenePaths.of(dataset, 1))
    placed = sum(len(image.scene.objects) for image in recorded.values())
    shown = sum(len(image.instances) for image in recorded.values())
    assert shown / placed > 0.7


def test_the_canonical_pose_has_the_silhouette_of_the_true_pose(dataset: Path) -> None:
    """At a resolution of its own, so that a pixel is much smaller than a part."""
    recipe = read_recipe(dataset)
    small = recipe.intrinsics
    scale = 8
    camera = Intrinsics(
        small.width * scale,
        small.height * scale,
        small.fx * scale,
        small.fy * scale,
        (small.cx + 0.5) * scale - 0.5,
        (small.cy + 0.5) * scale - 0.5,
    )
    models = load_models(dataset / "models")
    caster = scene_caster({"model": models})
    scene = ScenePaths.of(dataset, 1)
    labels = records.read_scene_json(scene.scene_gt_canonical)
    for im_id, entries in records.read_scene_json(scene.scene_gt).items():
        for entry, label in zip(entries, labels[im_id], strict=True):
            silhouettes = []
            for R, t in (("cam_R_m2c", "cam_t_m2c"), ("cam_R_m2c_canonical", "cam_t_m2c_canonical")):
                source = entry if R in entry else label
                posed = PosedModel(entry["obj_id"], np.array(source[R]).reshape(3, 3), np.array(source[t]))
                silhouettes.append(caster.annotate(camera, None, [posed]).instances[0].mask)
            union = (silhouettes[0] | silhouettes[1]).sum()
            assert (silhouettes[0] & silhouettes[1]).sum() / union >= 0.999, (im_id, entry["obj_id"])


def test_the_contact_sheet_is_drawn_soon_and_now_and_then(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the first drop, and whenever two more images are there; three drops of two views each."""
    drawn: list[int] = []

    def draw(dataset: Path, to: Path, split: str) -> None:
        drawn.append(read_json(dataset / "dataset.json")["counts"]["images"])

    monkeypatch.setattr("synthetless.generation.generate.write_contact_sheet", draw)
    small = load_recipe(recipe, ["outputs=[rgb]", "render.samples=1"])
    generate(small, tmp_path / "d", Execution(workers=1, preview_every=2))
    assert drawn == [2, 4, 6, 6]
    drawn.clear()
    generate(small.model_copy(update={"images": 8}), tmp_path / "d", Execution(workers=1))
    assert drawn == [8]


def test_what_is_too_far_for_the_depth_image_has_no_valid_pixel(recipe: Path, tmp_path: Path) -> None:
    far = ["images=1", "camera.distance_m=[8, 9]", "camera.fx=1700", "camera.fy=1700", "outputs=[depth, masks]"]
    generate(load_recipe(recipe, [*far, "camera.views_per_drop=1"]), tmp_path / "d", Execution(workers=1))
    (entries,) = records.read_scene_json(ScenePaths.of(tmp_path / "d", 1).scene_gt_info).values()
    assert [entry["px_count_valid"] for entry in entries] == [0] * len(entries)
    assert max(entry["px_count_visib"] for entry in entries) > 100
    found = validate(tmp_path / "d")
    assert found.valid, found.lines()
