"""Other pictures of the same scenes: everything but the pictures stays as it is, to the byte."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from trees import contents
from valid_dataset import small_scene_folders, write_dataset

from synthetless.config import RecipeError, load_recipe
from synthetless.dataset.layout import PENDING_FILE, ScenePaths
from synthetless.dataset.reader import Dataset, read_recipe, read_specs
from synthetless.dataset.records import ImageSpec
from synthetless.dataset.store import DatasetStore
from synthetless.errors import UserError
from synthetless.generation.generate import Execution, generate
from synthetless.generation.redevelop import redevelop
from synthetless.generation.rerender import render_again
from synthetless.io.files import LockedError, locked, read_json, write_json
from synthetless.io.images import encode_exr
from synthetless.io.models import load_models
from synthetless.scenes.sampling import sample_sensor
from synthetless.scenes.sensor import capture, expose
from synthetless.scenes.settings import SensorSettings
from synthetless.validation import validate

OUTPUTS = "outputs=[rgb, depth, depth_sensed, masks, normals, object_coordinates, exr]"
TOLD_OF_PICTURES = {"README.md", "preview.jpg"}


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory, parts: Path) -> Path:
    """A dataset of six images with EXR files, without a sensor."""
    root = tmp_path_factory.mktemp("plain") / "dataset"
    write_dataset(root, parts, [OUTPUTS])
    return root


@small_scene_folders()
def developed(root: Path, to: Path, *overrides: str) -> dict[str, bytes]:
    """Redevelop in this process, and give every file of the result."""
    assert redevelop(root, to, overrides, workers=1) == 6
    return contents(to)


def pictures_and_records(files: dict[str, bytes]) -> set[str]:
    return {
        name
        for name in files
        if "/rgb/" in name or name.startswith(".records/") or name.endswith(("scene_spec.jsonl", "dataset.json"))
    }


def test_a_sensor_changes_pictures_and_records_of_it_alone(tmp_path: Path, plain: Path, parts: Path) -> None:
    write_dataset(tmp_path / "seen", parts, [OUTPUTS, "sensor=primesense"])
    before, after = contents(plain), contents(tmp_path / "seen")
    assert before.keys() == after.keys()
    changed = {name for name in before if before[name] != after[name]}
    assert changed == pictures_and_records(before)


@pytest.mark.parametrize("sensor", ["sensor=primesense", "sensor.variant=3"])
def test_redeveloped_is_as_if_generated(tmp_path: Path, plain: Path, parts: Path, sensor: str) -> None:
    write_dataset(tmp_path / "generated", parts, [OUTPUTS, sensor])
    generated, again = contents(tmp_path / "generated"), developed(plain, tmp_path / "redeveloped", sensor)
    assert generated.keys() == again.keys() - TOLD_OF_PICTURES
    assert [name for name in generated if generated[name] != again[name]] == []


def test_twice_gives_the_same_bytes_and_the_dataset_stays(tmp_path: Path, plain: Path) -> None:
    before = contents(plain)
    first = developed(plain, tmp_path / "a", "sensor=ranges")
    assert developed(plain, tmp_path / "b", "sensor=ranges") == first
    assert contents(plain) == before


def test_a_variant_is_another_picture(tmp_path: Path, plain: Path) -> None:
    first, second = (
        developed(plain, tmp_path / name, "sensor.preset=primesense", f"sensor.variant={name}") for name in "01"
    )
    assert {name for name in first if first[name] != second[name]} - TOLD_OF_PICTURES == pictures_and_records(first)


def test_a_redeveloped_dataset_can_be_redeveloped(tmp_path: Path, plain: Path) -> None:
    """The overrides say all of the sensor: nothing is left of the one before."""
    developed(plain, tmp_path / "a", "sensor=primesense")
    again, directly = (
        developed(tmp_path / "a", tmp_path / "b", "sensor=ranges"),
        developed(plain, tmp_path / "c", "sensor=ranges"),
    )
    assert again == directly


@small_scene_folders()
def test_it_is_valid_and_can_be_continued(tmp_path: Path, plain: Path, parts: Path) -> None:
    redevelop(plain, tmp_path / "a", ["sensor=primesense"], workers=1)
    report = validate(tmp_path / "a", workers=1)
    assert report.findings == ()
    models = load_models(parts)
    store = DatasetStore.open(tmp_path / "a", read_recipe(tmp_path / "a"), models, "")
    assert store.missing() == []
    with pytest.raises(UserError, match=r"was begun with sensor\."):
        DatasetStore.open(tmp_path / "a", read_recipe(plain), models, "")


def test_worker_processes_give_the_same(tmp_path: Path, parts: Path) -> None:
    write_dataset(tmp_path / "d", parts, [OUTPUTS, "images=3"])
    for name, workers in (("a", 1), ("b", 2)):
        redevelop(tmp_path / "d", tmp_path / name, ["sensor=primesense"], workers)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_large_files_are_shared_and_tables_are_copied(tmp_path: Path, plain: Path) -> None:
    developed(plain, tmp_path / "a", "sensor=primesense")
    scene, own = ScenePaths.of(plain, 1), ScenePaths.of(tmp_path / "a", 1)
    assert own.depth(0).samefile(scene.depth(0))
    assert own.exr(0).samefile(scene.exr(0))
    assert not own.scene_gt.samefile(scene.scene_gt)
    assert not (tmp_path / "a" / "symmetries.json").samefile(plain / "symmetries.json")


def test_where_there_are_no_hard_links_files_are_copied(
    tmp_path: Path, plain: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    linked = developed(plain, tmp_path / "a", "sensor=primesense")

    def refuse(self: Path, target: Path) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    assert developed(plain, tmp_path / "b", "sensor=primesense") == linked


def test_pictures_are_made_where_there_were_none(tmp_path: Path, plain: Path, parts: Path) -> None:
    write_dataset(tmp_path / "d", parts, ["outputs=[masks, exr]"])
    files = developed(tmp_path / "d", tmp_path / "a", "sensor=primesense")
    pictures = developed(plain, tmp_path / "b", "sensor=primesense")
    assert len([name for name in files if "/rgb/" in name]) == 6
    assert all(files[name] == pictures[name] for name in files if "/rgb/" in name)
    assert set(read_recipe(tmp_path / "a").outputs) == {"masks", "exr", "rgb"}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([], "needs a sensor"),
        (["sensor=none"], "needs a sensor"),
        (["camera.width=640"], r"--set camera\.width=640: redevelop changes the sensor alone"),
        (["sensors=primesense"], "changes the sensor alone"),
        (["sensor=kinect"], "unknown sensor; give none, ranges, primesense"),
        (["sensor.photons=[2, 1]"], "min 2.0 is greater than max 1.0"),
        (["sensor"], r"expected key\.path=value"),
    ],
)
def test_a_wrong_request_is_refused_and_nothing_is_written(
    tmp_path: Path, plain: Path, overrides: list[str], message: str
) -> None:
    with pytest.raises((UserError, RecipeError), match=message) as caught:
        redevelop(plain, tmp_path / "a", overrides, workers=1)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_folders_that_cannot_serve_are_refused(tmp_path: Path, plain: Path, valid: Path) -> None:
    sensor = ["sensor=primesense"]
    with pytest.raises(UserError, match="has no EXR files"):
        redevelop(valid, tmp_path / "a", sensor, workers=1)
    with pytest.raises(UserError, match="not found"):
        redevelop(tmp_path / "missing", tmp_path / "a", sensor, workers=1)
    with pytest.raises(UserError, match="lies inside"):
        redevelop(plain, plain / "a", sensor, workers=1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(UserError, match="exists already"):
        redevelop(plain, tmp_path / "full", sensor, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


@small_scene_folders()
def test_a_damaged_dataset_is_refused_and_nothing_is_left(tmp_path: Path, plain: Path) -> None:
    root = tmp_path / "d"
    sensor = ["sensor=primesense"]
    shutil.copytree(plain, root)
    exr = ScenePaths.of(root, 2).exr(1)
    whole = exr.read_bytes()
    exr.write_bytes(whole[:200])
    with pytest.raises(UserError, match=r"000001\.exr: cannot be decoded"):
        redevelop(root, tmp_path / "a", sensor, workers=1)
    exr.write_bytes(encode_exr(np.ones((4, 6, 3), dtype=np.float32)))
    with pytest.raises(UserError, match=r"has 6 x 4 pixels; the recipe says 128 x 96"):
        redevelop(root, tmp_path / "a", sensor, workers=1)
    exr.unlink()
    with pytest.raises(UserError, match=r"000001\.exr: not found"):
        redevelop(root, tmp_path / "a", sensor, workers=1)
    exr.write_bytes(whole)
    (root / PENDING_FILE).touch()
    with pytest.raises(UserError, match="half relabelled"):
        redevelop(root, tmp_path / "a", sensor, workers=1)
    (root / PENDING_FILE).unlink()
    with locked(root), pytest.raises(LockedError):
        redevelop(root, tmp_path / "a", sensor, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["d"]
    assert contents(root) == contents(plain)


def test_a_draft_that_was_left_is_replaced(tmp_path: Path, plain: Path) -> None:
    """What a killed process leaves behind."""
    (tmp_path / ".a.part").mkdir()
    (tmp_path / ".a.part" / "leftover").touch()
    assert "leftover" not in developed(plain, tmp_path / "a", "sensor=primesense")


def test_the_picture_follows_from_the_record_and_the_exr_file(tmp_path: Path, plain: Path) -> None:
    developed(plain, tmp_path / "a", "sensor=ranges")
    recipe = read_recipe(tmp_path / "a")
    for image in Dataset.open(tmp_path / "a"):
        spec: ImageSpec = read_specs(image.paths)[image.im_id]
        assert recipe.sensor is not None
        assert spec.sensor == sample_sensor(recipe.sensor, recipe.seed, spec.scene.drop, spec.view)
        assert (image.rgb() == expose(image.linear(), spec.sensor, spec.exposure_gain)).all()
        crop = capture(image.linear()[10:42, 20:60], SensorSettings(), np.random.default_rng(0), spec.exposure_gain)
        assert crop.shape == (32, 40, 3)


@small_scene_folders()
def test_a_wrong_sensor_in_a_record_is_found(tmp_path: Path, plain: Path) -> None:
    redevelop(plain, tmp_path / "a", ["sensor=primesense"], workers=1)
    header = read_json(tmp_path / "a" / "dataset.json")
    header["recipe"]["sensor"]["variant"] = 1
    write_json(tmp_path / "a" / "dataset.json", header)
    found = validate(tmp_path / "a", workers=1).findings
    assert {finding.kind for finding in found} == {"spec"}
    assert len(found) == 6
    assert "another sensor" in found[0].message


@pytest.mark.blender
def test_a_rendered_image_is_rendered_again_as_its_camera_saw_it(tmp_path: Path) -> None:
    small = ["images=1", "camera.width=64", "camera.height=48", "objects.count=[1, 1]", "objects.ids=[1]"]
    recipe = load_recipe(None, [*small, "sensor=primesense", "outputs=[rgb, masks, exr]"])
    generate(recipe, tmp_path / "d", Execution(workers=1))
    (image,) = Dataset.open(tmp_path / "d")
    assert (render_again(tmp_path / "d", image.scene_id, image.im_id) == image.rgb()).all()
    redevelop(tmp_path / "d", tmp_path / "same", ["sensor=primesense"], workers=1)
    before, after = contents(tmp_path / "d"), contents(tmp_path / "same")
    assert [name for name in after if after[name] != before[name]] == []
