"""The output depth_sensed: beside the exact depth, recomputable, and nothing else is changed by it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from valid_dataset import small_scene_folders, write_dataset, write_models

from synthetless.config import RecipeError, load_recipe
from synthetless.dataset import Dataset
from synthetless.dataset.reader import read_recipe, read_specs
from synthetless.errors import UserError
from synthetless.exports.bop import export_bop
from synthetless.io.files import read_json_lines, write_json_lines
from synthetless.preview.image import _sections
from synthetless.validation import validate

OUTPUTS = "outputs=[rgb, depth, masks, normals, depth_sensed]"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sensed")
    models = write_models(folder / "models")
    write_dataset(folder / "without", models, ["images=2", "outputs=[rgb, depth, masks, normals]"])
    sensed = ["images=2", OUTPUTS, "objects.grey=[0, 0.9]", "depth_sensor.dark=[0.02, 0.04]"]
    write_dataset(folder / "sensed", models, sensed)
    write_dataset(folder / "again", models, sensed)
    return folder


@pytest.fixture(autouse=True)
def _small_scene_folders() -> Iterator[None]:
    with small_scene_folders():
        yield


@pytest.fixture
def dataset(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made / "sensed", tmp_path / "dataset"))


def test_it_lies_beside_the_exact_depth_and_changes_nothing_else(made: Path) -> None:
    for path in sorted((made / "sensed").rglob("*.png")):
        if path.parent.name != "depth_sensed":
            assert path.read_bytes() == (made / "without" / path.relative_to(made / "sensed")).read_bytes()
        assert path.read_bytes() == (made / "again" / path.relative_to(made / "sensed")).read_bytes()
    for image in Dataset.open(made / "sensed"):
        exact, sensed = image.depth_mm(), image.depth_sensed_mm()
        both = (exact > 0) & (sensed > 0)
        assert 0.3 < (sensed > 0).mean() < 0.99, "shadows and grazing faces are missing"
        assert 0.5 < np.median(np.abs(sensed - exact)[both]) < 3


def test_it_is_valid_and_damage_is_found(dataset: Path) -> None:
    assert validate(dataset, workers=1).valid
    path = dataset / "train_synthetless/000001/depth_sensed/000001.png"
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    depth[40:60, 40:60] += 20
    cv2.imwrite(str(path), depth)
    found = validate(dataset, workers=1).findings
    assert [(f.kind, f.image, f.file.name) for f in found] == [("depth", 1, "000001.png")]
    assert "pixels differ from the recomputed depth of the depth camera, by up to 2.0" in found[0].message
    path.unlink()
    assert [f.kind for f in validate(dataset, workers=1).findings] == ["missing"]


def test_a_camera_that_was_not_drawn_is_found(dataset: Path) -> None:
    path = dataset / "train_synthetless/000001/scene_spec.jsonl"
    lines = read_json_lines(path)
    lines[0]["depth_sensor"]["noise_mm"] = 1.3
    write_json_lines(path, lines)
    found = validate(dataset, workers=1).findings
    assert any("records another depth sensor than the recipe draws" in f.message for f in found)


def test_what_was_drawn_is_recorded(made: Path) -> None:
    image = Dataset.open(made / "sensed")[0]
    drawn = read_specs(image.paths)[image.im_id].depth_sensor
    assert drawn is not None
    assert (drawn.baseline_m, drawn.edges) == (0.075, "sharp")
    assert 0.02 <= drawn.dark <= 0.04
    assert 75 <= drawn.grazing_deg <= 85
    assert read_recipe(made / "sensed").depth_sensor is not None
    assert read_specs(Dataset.open(made / "without")[0].paths)[0].depth_sensor is None
    shown = {row[0]: row[1] for section in _sections(image, read_specs(image.paths)[0]) for row in section["rows"]}
    assert shown["axial noise"] == "1.20 mm, 1.90 mm per m² beyond 0.40 m"
    assert shown["steps"] == "0.125 px of disparity"


@pytest.mark.parametrize(
    ("overrides", "fault"),
    [
        (
            ["outputs=[depth_sensed]", "depth_sensor=none"],
            "depth_sensed needs depth_sensor: structured_light or time_of",
        ),
        (["outputs=5"], r"outputs = 5: expected a list, such as .* or \[rgb, depth\]"),
        (["outputs=exr"], r"outputs = 'exr': expected a list"),
        (["depth_sensor=lidar"], "unknown depth sensor; give none, structured_light, time_of_flight"),
        (["depth_sensor.dark=[0.5, 0.1]"], r"depth_sensor\.dark = \[0\.5, 0\.1\]: min 0\.5 is greater than max 0\.1"),
        (["depth_sensor.noise_order=3"], r"noise_order = 3: 3 is outside 1\.\.2"),
        (["depth_sensor.baselin_m=[0, 0]"], r"did you mean depth_sensor\.baseline_m"),
    ],
)
def test_bad_settings_are_refused_in_a_line(overrides: list[str], fault: str) -> None:
    with pytest.raises(RecipeError, match=fault) as refused:
        load_recipe(None, overrides)
    assert "\n" not in str(refused.value)


def test_a_name_stands_for_its_settings() -> None:
    named = load_recipe(None, ["depth_sensor=time_of_flight", "depth_sensor.baseline_m=[0.02, 0.03]"]).depth_sensor
    assert named is not None
    assert (named.edges, named.baseline_m, named.step_mm) == ("mixed", (0.02, 0.03), (1.0, 1.0))
    assert (
        load_recipe(None, ["outputs=[depth_sensed]"]).depth_sensor
        == load_recipe(None, ["depth_sensor=structured_light"]).depth_sensor
    )


def test_loaders_may_be_given_it_as_depth(made: Path, tmp_path: Path) -> None:
    export_bop(made / "sensed", tmp_path, depth="sensed", workers=1)
    sensed = (made / "sensed/train_synthetless/000001/depth_sensed/000001.png").read_bytes()
    assert (tmp_path / "tless/train_pbr/000000/depth/000001.png").read_bytes() == sensed
    with pytest.raises(UserError, match=r"depth_sensed/000000\.png: not there; generate the dataset with depth_sensed"):
        export_bop(made / "without", tmp_path / "other", depth="sensed", workers=1)
    assert not (tmp_path / "other/tless").exists()
