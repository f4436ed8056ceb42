"""scene_gt_ambiguity.json: written for datasets of ours and of others, read, checked, exported; whatever happens."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import valid_dataset
from pycocotools.coco import COCO
from trees import contents
from typer.testing import CliRunner

from synthetless.annotation.raycast import RayCaster
from synthetless.cli.commands import app
from synthetless.dataset import Dataset
from synthetless.dataset import ambiguity as module
from synthetless.dataset.ambiguity import AmbiguitySource, see_images, write_ambiguity
from synthetless.dataset.reader import Scene
from synthetless.dataset.relabel import adopt, relabel
from synthetless.errors import UserError
from synthetless.exports.coco import export_coco
from synthetless.exports.webdataset import export_webdataset, relabel_webdataset
from synthetless.io.images import encode_depth
from synthetless.learning.targets import LabelMaker, coset_targets
from synthetless.preview.statistics import statistics
from synthetless.symmetry.ambiguity import Cosets
from synthetless.symmetry.quaternions import to_matrix
from synthetless.validation import validate

TABLE = """
1: {group: C1, quasi: {group: C2, axis: [0, 0, 1], tolerance_mm: 60}}
3: {group: C2, quasi: D2}
"""
FILE = "scene_gt_ambiguity.json"
SCENES = ("000001", "000002")


@pytest.fixture(scope="module")
def judged(valid: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose angle is taken for C2 and whose box is D2, judged with the poses; only read."""
    folder = tmp_path_factory.mktemp("judged")
    (folder / "table.yaml").write_text(TABLE)
    root = Path(shutil.copytree(valid, folder / "d"))
    relabel(root, folder / "table.yaml", workers=1)
    write_ambiguity(root, with_poses=True, workers=1)
    return root


@pytest.fixture
def root(judged: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(judged, tmp_path / "d"))


def files(root: Path) -> dict[str, Path]:
    return {name: root / "train_synthetless" / name / FILE for name in SCENES}


def entries(root: Path) -> list[dict[str, Any]]:
    contents_of = [json.loads(path.read_text()) for path in files(root).values()]
    return [entry for content in contents_of for image in content.values() for entry in image if entry]


def test_what_is_written(judged: Path) -> None:
    found = entries(judged)
    assert {entry["obj_id"] for entry in found} == {1, 3}
    # A box is D2: no image tells the turned one apart. An angle of 60 mm is none: most images do.
    boxes = [entry for entry in found if entry["obj_id"] == 3]
    assert all(entry["view_ambiguity"] == 1 and entry["pixels_apart"] == [0, 0] for entry in boxes)
    angles = [entry["view_ambiguity"] for entry in found if entry["obj_id"] == 1]
    assert np.mean(angles) < 0.8 and set(angles) <= {0.5, 1.0}
    stamp = json.loads((judged / "ambiguity.json").read_text())
    assert stamp["objects"]["3"]["cosets_wxyz"][0] == [1, 0, 0, 0]
    assert len(stamp["objects"]["3"]["cosets_wxyz"]) == 2
    assert not (judged / ".ambiguity.json").exists()


def test_the_reader_gives_poses_that_look_alike(judged: Path) -> None:
    table, dataset = Dataset.open(judged).symmetries, Dataset.open(judged)
    seen = [instance for image in dataset for instance in image.instances]
    assert {instance.obj_id for instance in seen if instance.quasi is None} == {2}
    for instance in (instance for instance in seen if instance.quasi is not None):
        quasi, entry = instance.quasi, table.entries[instance.obj_id]
        assert quasi is not None and entry.quasi is not None
        larger = entry.quasi.group
        assert larger.appearance_distance_deg(instance.R_m2c[None], quasi.R_m2c[None])[0] < 1e-6
        assert quasi.alike[quasi.coset_true] and quasi.pixels_apart[quasi.coset_true] == 0
        assert quasi.R_alike is not None and quasi.t_alike is not None
        assert len(quasi.R_alike) == len(quasi.t_alike) == quasi.alike.sum() * entry.group.order
        off = np.abs(quasi.R_alike - instance.R_m2c).max(axis=(1, 2)) + np.abs(quasi.t_alike - instance.t_m2c).max(
            axis=1
        )
        assert off.min() < 1e-9


def test_they_are_learned_coarsely_then_finely(judged: Path) -> None:
    dataset = Dataset.open(judged)
    seen = [instance for image in dataset for instance in image.instances]
    table = dataset.symmetries
    maker = LabelMaker("atlas", table)
    labels = coset_targets(seen, maker)
    exact = maker([n.obj_id for n in seen], np.array([n.R_m2c for n in seen]), np.array([n.t_m2c for n in seen]))
    assert labels.alike.shape == (len(seen), 2)
    for i, instance in enumerate(seen):
        if instance.quasi is None:
            assert labels.n_cosets[i] == 1 and labels.alike[i].tolist() == [True, False]
            assert np.array_equal(labels.poses.R_m2c[i], exact.R_m2c[i])
            assert labels.poses.margin_deg[i] == exact.margin_deg[i]
            continue
        assert labels.n_cosets[i] == 2 and labels.alike[i].tolist() == instance.quasi.alike.tolist()
        assert np.isnan(labels.poses.margin_deg[i])
        assert labels.poses.regressor_index[i] < labels.poses.n_regressors[i] == instance.quasi.n_indices
        entry = table.entries[instance.obj_id]
        assert entry.quasi is not None
        turn = to_matrix(Cosets.of(entry.quasi.group, entry.group).representatives_wxyz[instance.quasi.coset_true])
        fine = labels.poses.R_m2c[i] @ turn  # the coarse pose and the true coset are the true pose
        assert entry.group.appearance_distance_deg(instance.R_m2c[None], fine[None])[0] < 1e-6
    assert len(coset_targets([], maker).n_cosets) == 0


def test_it_is_valid_and_every_damage_is_told(root: Path, small_scene_folders: None) -> None:
    assert validate(root, workers=1).lines()[-1].endswith("valid")
    path = files(root)["000001"]
    sound = path.read_text()

    def damaged(**changes: object) -> list[str]:
        content = json.loads(sound)
        image = next(image for image in content.values() if any(image))
        entry = next(entry for entry in image if entry)
        entry |= {key: value(entry) if callable(value) else value for key, value in changes.items()}
        path.write_text(json.dumps(content))
        report = validate(root, workers=1)
        return [f"{finding.kind}: {finding.message}" for finding in report.findings]

    assert "ambiguity: pixels_apart has 1 numbers; there are 2 cosets" in damaged(pixels_apart=[0])
    assert any("coset_true" in line for line in damaged(coset_true=7))
    assert any("view_ambiguity" in line for line in damaged(view_ambiguity=0.1))
    assert any("is recomputed" in line for line in damaged(quasi_index=lambda e: e["quasi_index"] + 1))
    assert any(line.startswith("ids") for line in damaged(obj_id=2))
    assert any(line.startswith("schema") for line in damaged(eps_mm=-1.0))
    assert any("cam_t_m2c_quasi is off" in line for line in damaged(cam_t_m2c_quasi=[0.0, 0.0, 500.0]))
    invented = {"pixels_apart": lambda e: [0 if i == e["coset_true"] else 999 for i in range(2)]}
    told = damaged(**invented, cosets_alike=lambda e: [e["coset_true"]], view_ambiguity=0.5)
    assert any("of coset" in line and "is recomputed" in line for line in told)
    path.unlink()
    assert [finding.kind for finding in validate(root, workers=1).findings] == ["missing"]


def test_other_symmetries_or_poses_make_it_stale(root: Path, tmp_path: Path, small_scene_folders: None) -> None:
    before = contents(root)
    (tmp_path / "table.yaml").write_text("3: {group: C2, quasi: O}")
    relabel(root, tmp_path / "table.yaml", workers=1)
    assert all(instance.quasi is None for image in Dataset.open(root) for instance in image.instances)
    assert {finding.kind for finding in validate(root, workers=1).findings} == {"stale"}
    again = write_ambiguity(root, with_poses=True, workers=1)
    assert again.made == 2
    assert {entry["n_cosets"] for entry in entries(root) if entry["obj_id"] == 3} == {12}
    assert validate(root, workers=1).valid
    (tmp_path / "table.yaml").write_text(TABLE)
    relabel(root, tmp_path / "table.yaml", workers=1)
    write_ambiguity(root, with_poses=True, workers=1)
    assert contents(root) == before


def test_it_goes_on_where_it_was_interrupted(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(root)
    assert write_ambiguity(root, with_poses=True, workers=1).made == 0
    files(root)["000002"].unlink()
    assert write_ambiguity(root, with_poses=True, workers=1).made == 1
    assert contents(root) == before
    real = module.write_json

    def full_disk(path: Path, content: dict[str, Any]) -> None:
        if path == files(root)["000002"]:
            raise UserError("no space left")
        real(path, content)

    monkeypatch.setattr(module, "write_json", full_disk)
    with pytest.raises(UserError, match="no space left"):
        write_ambiguity(root, eps_mm=5.0, workers=1)
    monkeypatch.undo()
    assert not (root / "ambiguity.json").exists() and files(root)["000001"].exists()
    assert all(instance.quasi is None for image in Dataset.open(root) for instance in image.instances)
    assert write_ambiguity(root, eps_mm=5.0, workers=1).made == 1
    assert write_ambiguity(root, with_poses=True, workers=2).made == 2
    assert contents(root) == before


def _killed_at(step: int, root: Path) -> None:
    """Judge with another eps, and die before the step-th change on the disk."""
    left = step

    def or_die(real: Callable[..., None]) -> Callable[..., None]:
        def change(*arguments: Any) -> None:
            nonlocal left
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            real(*arguments)

        return change

    for name in ("write_json", "remove_file", "replace_file"):
        setattr(module, name, or_die(getattr(module, name)))
    write_ambiguity(root, eps_mm=5.0, workers=1)


def _is_former(root: Path) -> bool:
    stamp = root / "ambiguity.json"
    return stamp.exists() and json.loads(stamp.read_text())["eps_mm"] is None


def test_a_kill_before_any_change_on_disk_loses_nothing(judged: Path, tmp_path: Path) -> None:
    whole = Path(shutil.copytree(judged, tmp_path / "whole"))
    write_ambiguity(whole, eps_mm=5.0, workers=1)
    steps = 0
    while True:
        root = Path(shutil.copytree(judged, tmp_path / "d"))
        child = multiprocessing.get_context("fork").Process(target=_killed_at, args=(steps + 1, root))
        child.start()
        child.join()
        if child.exitcode == 0:
            break
        assert child.exitcode == -signal.SIGKILL
        seen = [instance.quasi for image in Dataset.open(root) for instance in image.instances]
        assert all(quasi is None or (quasi.eps_mm == 5.0) == (not _is_former(root)) for quasi in seen)
        write_ambiguity(root, eps_mm=5.0, workers=1)
        assert contents(root) == contents(whole)
        shutil.rmtree(root)
        steps += 1
    assert steps >= 6
    assert contents(root) == contents(whole)


def test_datasets_of_others(root: Path, tmp_path: Path) -> None:
    """Without records, recipe and table: the same, since depth images show what hides."""
    own = {name: path.read_text() for name, path in files(root).items()}
    for name in ("dataset.json", "symmetries.json", "ambiguity.json"):
        (root / name).unlink()
    shutil.rmtree(root / ".records")
    for scene in SCENES:
        folder = root / "train_synthetless" / scene
        for name in (FILE, "scene_spec.jsonl", "scene_gt_canonical.json"):
            (folder / name).unlink()
    (tmp_path / "exact.yaml").write_text("{1: C1, 3: C2}")
    (tmp_path / "table.yaml").write_text(TABLE)
    adopt(root, symmetries=tmp_path / "exact.yaml", workers=1)
    labels = {path: text for path, text in contents(root).items() if not path.endswith("symmetries.json")}
    with pytest.raises(UserError, match="not found; a BOP models folder"):
        write_ambiguity(root, models=tmp_path, workers=1, symmetries=tmp_path / "table.yaml")
    assert not any(entry.quasi for entry in Dataset.open(root).symmetries.entries.values())
    write_ambiguity(root, with_poses=True, workers=1, symmetries=tmp_path / "table.yaml")
    assert labels.items() <= contents(root).items()
    assert json.loads((root / "ambiguity.json").read_text())["depth_images"]
    fields = ("obj_id", "cam_R_m2c_quasi", "coset_true", "cosets_alike", "eps_mm")
    for name, text in own.items():
        before, after = json.loads(text), json.loads(files(root)[name].read_text())
        for im_id, image in before.items():
            for one, other in zip(image, after[im_id], strict=True):
                assert (one is None) == (other is None)
                assert one is None or [one[field] for field in fields] == [other[field] for field in fields]
    assert validate(root, workers=1).valid
    adopt(root, symmetries=tmp_path / "table.yaml", workers=1)
    depth = root / "train_synthetless" / SCENES[0] / "depth" / "000000.png"
    depth.write_bytes(encode_depth(np.full((9, 16), 500.0), 0.1))
    with pytest.raises(UserError, match="is 16 x 9 pixels large; the images are 128 x 96"):
        write_ambiguity(root, eps_mm=2.0, workers=1)


def test_objects_without_a_quasi_symmetry_cost_nothing(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = AmbiguitySource.read(root)
    (root / "symmetries.json").write_text("{1: C1, 2: O(2), 3: {group: C2, quasi: D2}}")
    scene = Scene.read(Dataset.open(root).paths(1))

    def cast(*_: object) -> None:
        raise AssertionError("a ray was cast")

    monkeypatch.setattr(RayCaster, "pose", cast)
    bare = AmbiguitySource(root, Dataset.open(root).symmetries, source.resolution, False, source.meshes, {}, (128, 96))
    found = [number for number in range(len(scene)) if 3 not in _objects(scene, number)]
    assert all(entry is None for image in see_images(bare, scene, found) for entry in image)


def _objects(scene: Scene, number: int) -> list[int]:
    first, end = scene.poses.first[number : number + 2]
    return [int(obj_id) for obj_id in scene.poses.obj_ids[first:end]]


def test_distractors_hide(tmp_path: Path, parts: Path, small_scene_folders: None) -> None:
    """Moved to right before the camera, a ball leaves nothing to see."""
    root, balls = tmp_path / "d", valid_dataset.write_distractors(tmp_path / "balls")
    overrides = ("objects.distractors=[2, 3]", f"source.distractors={balls}")
    valid_dataset.write_dataset(root, parts, overrides)
    (tmp_path / "table.yaml").write_text(TABLE)
    relabel(root, tmp_path / "table.yaml", workers=1)
    write_ambiguity(root, workers=1)
    assert any(entry["view_ambiguity"] < 1 for entry in entries(root))
    assert validate(root, workers=1).valid
    balls.rename(tmp_path / "elsewhere")
    assert validate(root, workers=1).valid  # what cannot be recomputed is noted
    (tmp_path / "elsewhere").rename(balls)
    for name in SCENES:
        folder = root / "train_synthetless" / name
        cameras = json.loads((folder / "scene_camera.json").read_text())
        lines = [json.loads(line) for line in (folder / "scene_spec.jsonl").read_text().splitlines()]
        for line in lines:
            camera = cameras[str(line["image_id"])]
            R, t = np.reshape(camera["cam_R_w2c"], (3, 3)), np.array(camera["cam_t_w2c"])
            for item, pose in zip(line["scene"]["objects"], line["settled"], strict=True):
                if item["role"] == "distractor":
                    pose["position_m"] = (R.T @ ([0, 0, 50] - t) / 1000).tolist()
        (folder / "scene_spec.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert write_ambiguity(root, workers=1).made == 2
    assert all(entry["view_ambiguity"] == 1 for entry in entries(root))


def test_a_box_hides(tmp_path: Path, parts: Path, small_scene_folders: None) -> None:
    """The same objects with and without one: behind its sides no pixel tells poses apart."""
    (tmp_path / "table.yaml").write_text(TABLE)
    sides = ("release.container.box.sides_m=[0.13, 0.14]", "release.container.box.height_m=[0.1, 0.15]")
    apart = []
    for name, overrides in (("open", ()), ("boxed", ("release.container=box", *sides))):
        valid_dataset.write_dataset(tmp_path / name, parts, overrides)
        relabel(tmp_path / name, tmp_path / "table.yaml", workers=1)
        write_ambiguity(tmp_path / name, workers=1)
        apart.append([sum(entry["pixels_apart"]) for entry in entries(tmp_path / name)])
    assert len(apart[0]) == len(apart[1])
    assert sum(apart[1]) < 0.9 * sum(apart[0])


def test_exports(root: Path, tmp_path: Path, small_scene_folders: None) -> None:
    export_coco(root, tmp_path / "coco.json")
    coco = COCO(str(tmp_path / "coco.json"))
    for annotation in coco.anns.values():
        assert ("view_ambiguity" in annotation) == (annotation["category_id"] != 2)
        assert "poses_alike" not in annotation and "eps_mm" not in annotation
    export_webdataset(root, tmp_path / "shards", workers=1)
    report = validate(root, exports=[tmp_path / "coco.json", tmp_path / "shards"], workers=1)
    assert report.valid, report.lines()
    (tmp_path / "table.yaml").write_text("1: C1\n3: C2")
    relabel(root, tmp_path / "table.yaml", workers=1)
    for path in (root / "ambiguity.json", *files(root).values()):
        path.unlink()
    relabel_webdataset(root, tmp_path / "shards", workers=1)
    export_webdataset(root, tmp_path / "anew", workers=1)
    assert contents(tmp_path / "shards") == contents(tmp_path / "anew")
    assert not (tmp_path / "anew" / "ambiguity.json").exists()


def test_statistics_count_the_views_that_show_the_detail(judged: Path, tmp_path: Path) -> None:
    of = statistics(judged)
    angle, cylinder, box = of.classes
    assert cylinder.detail is None
    assert angle.detail is not None and box.detail is not None
    assert (box.detail.quasi, box.detail.visible, box.detail.mean_view_ambiguity) == ("D2", 0.0, 1.0)
    found = [entry for entry in entries(judged) if entry["obj_id"] == 1]
    assert angle.detail.visible == np.mean([len(entry["cosets_alike"]) == 1 for entry in found])
    assert np.sum(angle.detail.views_visible) == round(angle.detail.visible * angle.instances)
    assert (np.array(angle.detail.views_visible) <= np.array(angle.views)).all()
    json.dumps(of.to_json())


def test_the_command(root: Path) -> None:
    done = CliRunner().invoke(app, ["ambiguity", str(root), "--workers", "1", "--what", "silhouette", "--eps-mm", "2"])
    assert done.exit_code == 0, done.output
    assert "object 3: C2 in D2; the detail that separates them is visible in 0 of" in done.output
    told = CliRunner().invoke(app, ["ambiguity", str(root), "--workers", "1", "--json", "--what", "silhouette"])
    assert json.loads(told.output)["made"] == 2


def test_larger_groups_are_given_by_a_table_and_labels_stay(
    valid: Path, judged: Path, tmp_path: Path, small_scene_folders: None
) -> None:
    root = Path(shutil.copytree(valid, tmp_path / "d"))
    (tmp_path / "table.yaml").write_text(
        "{1: {group: C1, quasi: {group: C2, axis: [0, 0, 1], tolerance_mm: 60}}, 2: O(2), 3: D2}"
    )
    command = ["ambiguity", str(root), "--symmetries", str(tmp_path / "table.yaml"), "--workers", "1"]
    done = CliRunner().invoke(app, [*command, "--poses"])
    assert done.exit_code == 0, done.output
    assert contents(root) == contents(judged)
    assert validate(root, workers=1).valid
    for text, message in (
        ("{1: {group: C3, quasi: D3}}", "the group is C3, but the labels are of C1"),
        ("{2: C4}", "does not contain the group"),
        ("{3: SO(3)}", "cannot be sampled"),
        ("{9: C4}", "object 9 is none of the dataset's objects 1, 2, 3"),
    ):
        (tmp_path / "table.yaml").write_text(text)
        with pytest.raises(UserError, match=message):
            write_ambiguity(root, with_poses=True, workers=1, symmetries=tmp_path / "table.yaml")
    assert contents(root) == contents(judged)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{1: C1, 2: C1, 3: C1}", "no object has a quasi-symmetry group"),
        ("{1: {group: C1, quasi: SO(3)}, 2: C1, 3: C1}", "object 1: the quasi-symmetry group SO(3) cannot be sampled"),
    ],
)
def test_symmetries_that_are_refused(root: Path, text: str, message: str) -> None:
    (root / "symmetries.json").write_text(text)
    before = contents(root)
    with pytest.raises(UserError, match=message.replace("(", r"\(").replace(")", r"\)")):
        write_ambiguity(root, workers=1)
    assert contents(root) == before


def test_folders_that_are_refused(root: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        write_ambiguity(tmp_path / "nowhere")
    with pytest.raises(UserError, match="adopt labels a BOP dataset"):
        (tmp_path / "empty").mkdir()
        write_ambiguity(tmp_path / "empty")
    with pytest.raises(UserError, match="eps_mm is 0"):
        write_ambiguity(root, eps_mm=0.0)
    with pytest.raises(UserError, match="use one of depth"):
        write_ambiguity(root, "colour")  # type: ignore[arg-type]
    (root / "models" / "obj_000002.ply").unlink()
    with pytest.raises(UserError, match="no mesh for object 2"):
        write_ambiguity(root)
