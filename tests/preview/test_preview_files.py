"""What a preview writes, and what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from trees import contents

from synthetless.dataset import Dataset
from synthetless.dataset.labels import box_corners_mm
from synthetless.io.files import read_bytes
from synthetless.io.images import decode_mask, decode_rgb
from synthetless.io.models import BOX_EDGES
from synthetless.preview import write_preview
from synthetless.preview.image import box_lines, outline
from tests.preview.conftest import HOSTILE_NAME, images_of

K = np.array([[300.0, 0, 63.2], [0, 298.0, 47.7], [0, 0, 1]])
SEGMENT = 4


def test_every_image_has_its_files_and_every_file_is_an_images(small_preview: Path, small_dataset: Path) -> None:
    keys = [image.key for image in images_of(small_dataset)]
    assert [key for key, _ in _index(small_preview)["images"]] == keys
    folder = small_preview.parent
    assert sorted(str(p.relative_to(folder)) for p in (folder / "thumbnails").rglob("*.jpg")) == [
        f"thumbnails/{key}.jpg" for key in keys
    ]
    for key in keys:
        detail = _detail(small_preview, key)
        assert list(detail["views"]) == ["rgb", "depth", "normals"]
        for view in detail["views"].values():
            assert decode_rgb(read_bytes(folder / unquote(view))).shape == (96, 128, 3)


def test_the_index_says_what_the_labels_say(small_preview: Path, small_dataset: Path) -> None:
    for (_, flat), image in zip(_index(small_preview)["images"], images_of(small_dataset), strict=True):
        expected = [
            value
            for label, info in zip(image.labels.gt_canonical, image.labels.gt_info, strict=True)
            for value in (
                label["obj_id"],
                label["regressor_index"],
                round(1000 * info["visib_fract"]),
                round(10 * label["discontinuity_margin_deg"]),
            )
        ]
        assert flat == expected


def test_canonical_boxes_are_drawn_where_the_labels_put_their_corners(small_preview: Path, small_dataset: Path) -> None:
    for image in images_of(small_dataset):
        drawn = _detail(small_preview, image.key)["instances"]
        for label, instance in zip(image.labels.gt_canonical, drawn, strict=True):
            ends = np.array(instance["canonical"]["box"]).reshape(12, 2, 2)
            corners = np.array(label["bbox3d_corners_2d"])
            expected = np.array([[corners[a], corners[b]] for a, b in BOX_EDGES])
            np.testing.assert_allclose(ends, expected, atol=0.051)


def test_poses_that_look_alike_are_drawn_where_the_dataset_has_them(judged_preview: Path, judged_dataset: Path) -> None:
    drawn, infos = 0, Dataset.open(judged_dataset).models_info
    for image in Dataset.open(judged_dataset):
        shown = _detail(judged_preview, f"{image.paths.root.name}/{image.im_id:06d}")["instances"]
        for instance, of in zip(image.instances, shown, strict=True):
            assert of["cosets"] == {1: 0, 2: 24, 3: 2}[instance.obj_id]
            if instance.quasi is None or instance.quasi.R_alike is None or instance.quasi.t_alike is None:
                assert of["alike"] == []
                continue
            assert len(of["alike"]) == np.count_nonzero(instance.quasi.alike) - 1
            corners = box_corners_mm(infos[instance.obj_id])
            poses = zip(instance.quasi.R_alike, instance.quasi.t_alike, strict=True)
            expected = [box_lines(image.K, R, t, corners) for R, t in poses]
            assert all(ghost["box"] in expected and ghost["box"] != of["true"]["box"] for ghost in of["alike"])
            drawn += len(of["alike"])
    assert drawn > 100
    plots = {path.name for path in (judged_preview.parent / "plots").glob("detail_*")}
    assert plots == {"detail_2.svg", "detail_3.svg"}


def test_outlines_fill_what_the_masks_cover(small_preview: Path, small_dataset: Path) -> None:
    for image in images_of(small_dataset):
        for instance in _detail(small_preview, image.key)["instances"]:
            path = image.scene.mask(image.labels.im_id, instance["gt"])
            mask = decode_mask(read_bytes(path), path)
            filled = _filled(instance["outlines"]["amodal"], mask.shape)
            assert np.count_nonzero(filled != mask) <= 0.05 * mask.sum() + 5


@given(hnp.arrays(np.bool_, st.tuples(st.integers(1, 24), st.integers(1, 24))))
def test_outlines_stay_within_a_pixel_of_any_mask(mask: np.ndarray) -> None:
    filled = _filled(outline(mask), mask.shape)
    near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert not (filled & ~near).any()
    assert filled.any() == mask.any()


@given(st.floats(-400, 400), st.integers(0, 2**32 - 1))
def test_lines_stay_finite_and_before_the_camera(depth_mm: float, seed: int) -> None:
    R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    corners = box_corners_mm({f"min_{a}": -40 for a in "xyz"} | {f"size_{a}": 80 for a in "xyz"})
    lines = box_lines(K, R, np.array([5.0, -3.0, depth_mm]), corners)
    inside = (corners @ R.T + [5.0, -3.0, depth_mm])[:, 2] > 10
    assert np.isfinite(lines).all() if lines else not inside.any()
    assert len(lines) == sum(inside[a] or inside[b] for a, b in BOX_EDGES)
    assert all(len(line) == SEGMENT for line in lines)


def test_the_page_shows_a_hostile_name_as_text(small_preview: Path) -> None:
    class Reader(HTMLParser):
        scripts, heading, inside = 0, "", False

        def handle_starttag(self, tag: str, attrs: object) -> None:
            self.scripts += tag == "script"
            self.inside = tag == "h1"

        def handle_data(self, data: str) -> None:
            if self.inside:
                self.heading += data

        def handle_endtag(self, tag: str) -> None:
            self.inside = False

    reader = Reader()
    reader.feed(small_preview.read_text())
    assert reader.heading == HOSTILE_NAME
    assert reader.scripts == 5


def test_nothing_is_taken_from_elsewhere(small_preview: Path) -> None:
    for path in (p for p in small_preview.parent.rglob("*") if p.suffix in {".html", ".css", ".js"}):
        addresses = set(re.findall(r"https?://[^\s\"'`]+", path.read_text())) - {"http://www.w3.org/2000/svg"}
        assert not addresses, path


def test_the_same_dataset_gives_the_same_bytes(small_preview: Path, small_dataset: Path, tmp_path: Path) -> None:
    again = write_preview(small_dataset, tmp_path / "again")
    assert contents(again.parent) == contents(small_preview.parent)


def test_a_preview_is_replaced_and_nothing_else(small_dataset: Path, tmp_path: Path) -> None:
    to = tmp_path / "pages"
    write_preview(small_dataset, to, limit=4)
    keys = [image.key for image in images_of(small_dataset)]
    assert [key for key, _ in _index(to / "index.html")["images"]] == [keys[i] for i in (0, 1, 3, 4)]
    write_preview(small_dataset, to, limit=1)
    assert len(list((to / "thumbnails").rglob("*.jpg"))) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pages"]
    letters = tmp_path / "letters"
    letters.mkdir()
    (letters / "index.html").write_text("my own page")
    with pytest.raises(ValueError, match="is not a preview"):
        write_preview(small_dataset, letters)
    assert (letters / "index.html").read_text() == "my own page"


def test_the_datasets_own_pictures_are_shown_or_copies(small_dataset: Path, tmp_path: Path) -> None:
    linked = write_preview(small_dataset, tmp_path / "a folder #1 of 100%" / "linked", limit=1).parent
    copied = write_preview(small_dataset, tmp_path / "copied", limit=1, copy=True).parent
    key = images_of(small_dataset)[0].key
    shown = {folder: _detail(folder / "index.html", key)["views"]["rgb"] for folder in (linked, copied)}
    assert shown[copied] == f"images/{key}-rgb.jpg"
    path = (linked / unquote(shown[linked])).resolve()
    assert path == images_of(small_dataset)[0].scene.find_rgb(images_of(small_dataset)[0].labels.im_id)
    assert not (linked / f"images/{key}-rgb.jpg").exists()
    small = [_small(each) for each in (copied / shown[copied], path)]  # the pixels are noise, which JPEG smears
    assert np.abs(small[0] - small[1]).max() < 6 < np.ptp(small[1])


def test_what_has_not_changed_is_not_drawn_again(small_dataset: Path, tmp_path: Path) -> None:
    root = shutil.copytree(small_dataset, tmp_path / "z")
    folder = write_preview(root).parent
    before, images = contents(folder), images_of(root)
    inodes = {path: path.stat().st_ino for path in folder.rglob("*.j*g")}
    write_preview(root)
    assert contents(folder) == before
    assert {path: path.stat().st_ino for path in folder.rglob("*.j*g")} == inodes
    depth = images[1].scene.depth(images[1].labels.im_id)
    depth.write_bytes(images[2].scene.depth(images[2].labels.im_id).read_bytes())
    (folder / f"images/{images[3].key}-depth.jpg").unlink()
    write_preview(root)
    assert {key for key in contents(folder) if contents(folder)[key] != before[key]} >= {
        f"images/{images[1].key}-depth.jpg"
    }
    drawn = {path.parent.name + "/" + path.name for path, inode in inodes.items() if path.stat().st_ino != inode}
    assert {name[:13] for name in drawn} == {images[1].key, images[3].key}


@pytest.mark.parametrize("content", ["", "[]", '{"000001/000000": 3}', '{"000001/000000": ["x", ["../../passwd"]]}'])
def test_a_damaged_memory_of_what_was_drawn_is_forgotten(small_dataset: Path, tmp_path: Path, content: str) -> None:
    folder = write_preview(small_dataset, tmp_path / "pages", limit=1).parent
    before = contents(folder)
    (folder / "drawn.json").write_text(content)
    write_preview(small_dataset, folder, limit=1)
    assert contents(folder) == before


def test_the_first_page_opens_while_the_rest_is_drawn(
    small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("synthetless.preview.write.FIRST_IMAGES", 2)
    to, opened = tmp_path / "pages", list[tuple[int, int]]()

    def opens(page: Path) -> None:
        opened.append((len(list(to.glob("thumbnails/*/*"))), len(_index(page)["images"])))

    write_preview(small_dataset, to, opens=opens)
    assert opened == [(2, 6)]
    assert contents(to) == contents(write_preview(small_dataset, tmp_path / "other", limit=6).parent)
    write_preview(small_dataset, to, opens=opens)
    assert len(opened) == 1

    def interrupted(page: Path) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_preview(small_dataset, tmp_path / "left", opens=interrupted)
    assert not (tmp_path / "left").exists()


def test_a_damaged_dataset_leaves_the_former_preview(small_dataset: Path, tmp_path: Path) -> None:
    to = tmp_path / "pages"
    before = contents(write_preview(small_dataset, to, limit=2).parent)
    last = images_of(small_dataset)[-1]
    damaged = last.scene.depth(last.labels.im_id)
    content = damaged.read_bytes()
    damaged.write_bytes(content[:40])
    try:
        with pytest.raises(ValueError, match=re.escape(f"depth/{damaged.name}")):
            write_preview(small_dataset, to)
    finally:
        damaged.write_bytes(content)
    assert contents(to) == before


def test_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such dataset"):
        write_preview(tmp_path / "nowhere")


def _index(page: Path) -> dict[str, list]:
    text = (page.parent / "data" / "index.js").read_text()
    return json.loads(text.removeprefix("synthetless.index = ").removesuffix(";\n"))


def _detail(page: Path, key: str) -> dict:
    text = (page.parent / "data" / f"{key}.js").read_text()
    return json.loads(text.split(", ", 1)[1].removesuffix(");\n"))


def _small(path: Path) -> np.ndarray:
    return cv2.resize(decode_rgb(read_bytes(path)), (16, 12), interpolation=cv2.INTER_AREA).astype(np.float64)


def _filled(path: str, shape: tuple[int, ...]) -> np.ndarray:
    """The pixels that a path covers or touches, by the even-odd rule."""
    rings = [np.array(re.findall(r"(\d+) (\d+)", part), dtype=np.int32) for part in path.split("M") if part]
    filled = np.zeros(shape, np.uint8)
    if rings:
        cv2.fillPoly(filled, rings, 1)
    return filled.astype(bool)
