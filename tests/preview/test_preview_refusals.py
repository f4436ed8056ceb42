"""What a preview refuses: targets that are not its own, and datasets that it cannot draw."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from trees import contents

from synthetless.dataset.layout import ScenePaths
from synthetless.errors import UserError
from synthetless.preview import write_preview

SCENE = "train_synthetless/000001"


@pytest.fixture(scope="module", autouse=True)
def without_plots() -> Iterator[None]:
    """They take most of the time, and are not what is tried here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("synthetless.preview.pages.plots", lambda of: ())
        yield


@pytest.fixture
def copy(small_dataset: Path, tmp_path: Path) -> Path:
    return shutil.copytree(small_dataset, tmp_path / "z")


@pytest.fixture(scope="module")
def pages(without_plots: None, small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A preview of one image."""
    return write_preview(small_dataset, tmp_path_factory.mktemp("pages") / "pages", limit=1, workers=1).parent


@pytest.mark.parametrize(
    "place", ["", "..", SCENE, f"{SCENE}/rgb", f"{SCENE}/new", "train_synthetless/new", "models", ".records", ".new"]
)
def test_nothing_of_the_dataset_is_replaced(copy: Path, place: str) -> None:
    before = contents(copy)
    with pytest.raises(UserError, match=r"belongs to the dataset|holds the dataset"):
        write_preview(copy, copy / place)
    assert contents(copy) == before


@pytest.mark.parametrize(
    "name",
    [
        "notes.txt",
        "data/notes.txt",
        "images/holiday.jpg",
        "images/000001/000000-rgb.png",
        "images/000001/000000-other.jpg",
        "thumbnails/000001/cat.jpg",
        "plots/plot.svg.bak",
        "plots/a/b.svg",
        "preview.css.orig",
        "sub/index.html",
        ".hidden",
    ],
)
def test_a_preview_with_something_else_in_it_is_kept(
    pages: Path, small_dataset: Path, tmp_path: Path, name: str
) -> None:
    to = shutil.copytree(pages, tmp_path / "pages")
    (to / name).parent.mkdir(parents=True, exist_ok=True)
    (to / name).write_text("mine")
    before = contents(to)
    with pytest.raises(UserError, match=f"pages: holds {name}, which no preview writes"):
        write_preview(small_dataset, to, limit=1)
    assert contents(to) == before


def test_a_link_in_a_preview_is_kept(pages: Path, small_dataset: Path, tmp_path: Path) -> None:
    to = shutil.copytree(pages, tmp_path / "pages")
    (tmp_path / "mine").mkdir()
    (to / "plots").mkdir()
    (to / "plots" / "linked").symlink_to(tmp_path / "mine")
    with pytest.raises(UserError, match="holds plots/linked"):
        write_preview(small_dataset, to, limit=1)
    assert (tmp_path / "mine").is_dir()


@pytest.mark.parametrize("kind", ["file", "folder with a file", "folder with a page of its own"])
def test_what_is_no_preview_is_kept(small_dataset: Path, tmp_path: Path, kind: str) -> None:
    to = tmp_path / "mine"
    if kind == "file":
        to.write_text("mine")
    else:
        to.mkdir()
        (to / ("index.html" if "page" in kind else "letter")).write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(UserError, match="is not a preview"):
        write_preview(small_dataset, to, limit=1)
    assert contents(tmp_path) == before


def test_a_linked_target_is_written_where_the_link_leads(pages: Path, small_dataset: Path, tmp_path: Path) -> None:
    """The link stays, an empty folder and a former preview behind it are replaced, and so is nothing."""
    for behind in ("empty", "former", "nothing"):
        folder, link = tmp_path / behind, tmp_path / f"link to {behind}"
        if behind == "empty":
            folder.mkdir()
        elif behind == "former":
            shutil.copytree(pages, folder)
            (folder / "statistics.json").write_text("{}")
        link.symlink_to(folder)
        write_preview(small_dataset, link, limit=1)
        assert link.is_symlink()
        assert contents(folder) == contents(pages)


Damage = Callable[[Path], object]


def _model(**changes: Any) -> Damage:
    """Changes keys of object 1 in models_info.json; None removes one."""

    def damage(root: Path) -> None:
        path = root / "models" / "models_info.json"
        infos = json.loads(path.read_text())
        infos["1"] = {key: value for key, value in (infos["1"] | changes).items() if value is not None}
        path.write_text(json.dumps(infos))

    return damage


def _camera(**changes: Any) -> Damage:
    def damage(root: Path) -> None:
        path = root / "camera.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return damage


def _spec(**changes: Any) -> Damage:
    """Changes the record of the first image."""

    def damage(root: Path) -> None:
        path = ScenePaths.of(root, 1).scene_spec
        first, *others = path.read_text().splitlines()
        path.write_text("\n".join([json.dumps(json.loads(first) | changes), *others]))

    return damage


def _without(name: str) -> Damage:
    return lambda root: (root / name).unlink()


DAMAGES: dict[str, tuple[Damage, str]] = {
    "no diameter": (_model(diameter=None), r"models_info\.json: object 1 has diameter None; a positive number of mm"),
    "diameter as text": (_model(diameter="70"), "object 1 has diameter '70'"),
    "diameter in a list": (_model(diameter=[70.0]), r"object 1 has diameter \[70\.0\]"),
    "diameter true": (_model(diameter=True), "object 1 has diameter True"),
    "diameter zero": (_model(diameter=0), "object 1 has diameter 0"),
    "diameter negative": (_model(diameter=-3.0), r"object 1 has diameter -3\.0"),
    "diameter NaN": (_model(diameter=float("nan")), "object 1 has diameter nan"),
    "diameter infinite": (_model(diameter=float("inf")), "object 1 has diameter inf"),
    "diameter of 400 digits": (_model(diameter=10**400), "object 1 has diameter 1"),
    "no box": (_model(size_x=None), r"models_info\.json: object 1: the box needs the numbers min_x"),
    "box in a list": (_model(size_x=[30]), "object 1: the box needs the numbers"),
    "box as text": (_model(min_y="-3"), "object 1: the box needs the numbers"),
    "box NaN": (_model(size_z=float("nan")), "object 1: the box needs the numbers"),
    "width as text": (_camera(width="128"), r"camera\.json: width '128' and height 96; positive whole numbers"),
    "height null": (_camera(height=None), r"camera\.json: width 128 and height None"),
    "width negative": (_camera(width=-1), "width -1"),
    "view of another scene": (_spec(view=7), r"scene_spec\.jsonl: image 0 is not the one of scene_gt\.json"),
    "too few instances": (_spec(instances=[0]), "image 0 is not the one"),
    "unknown instances": (_spec(instances=[99] * 9), "image 0 is not the one"),
    "damaged record": (
        _spec(exposure_gain="high"),
        r"scene_spec\.jsonl: exposure_gain is .*high.*: input should be a valid",
    ),
    "no labels": (_without(f"{SCENE}/scene_gt_canonical.json"), r"scene_gt_canonical\.json: not found; adopt writes"),
    "no counts": (_without(f"{SCENE}/scene_gt_info.json"), r"scene_gt_info\.json: not found; bop_toolkit's"),
    "no models": (_without("models/models_info.json"), "holds no models_info.json in models, models_cad"),
    "no symmetries": (_without("symmetries.json"), r"symmetries\.json"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_dataset_is_one_line(copy: Path, tmp_path: Path, kind: str) -> None:
    damage, told = DAMAGES[kind]
    damage(copy)
    with pytest.raises(UserError, match=told) as raised:
        write_preview(copy, tmp_path / "pages", workers=1)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 700
    assert not (tmp_path / "pages").exists()


def test_the_size_is_the_pictures_where_no_camera_file_says_it(copy: Path, small_preview: Path, tmp_path: Path) -> None:
    """As in BOP's datasets that have a camera file for each sensor."""
    (copy / "camera.json").unlink()
    shutil.move(copy / "dataset.json", tmp_path / "dataset.json")
    page = write_preview(copy, tmp_path / "pages", workers=1)
    script = "data/000001/000000.js"
    assert '"size": [128, 96]' in (page.parent / script).read_text()
    shutil.rmtree(ScenePaths.of(copy, 1).root / "depth")
    shutil.rmtree(ScenePaths.of(copy, 1).root / "normals")
    shutil.rmtree(ScenePaths.of(copy, 1).root / "rgb")
    with pytest.raises(UserError, match=r"image 0 has no picture, and camera\.json does not say its size"):
        write_preview(copy, tmp_path / "other", workers=1)


def test_a_dataset_without_images_has_a_preview(copy: Path, tmp_path: Path) -> None:
    for scene in (copy / "train_synthetless").iterdir():
        for name in ("scene_camera", "scene_gt", "scene_gt_info", "scene_gt_canonical"):
            (scene / f"{name}.json").write_text("{}")
    page = write_preview(copy, tmp_path / "pages", workers=1)
    assert "0 images" in page.read_text()
