"""Relabelling: the files that assembling with the new symmetries would have written, whatever happens on the way."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from posed import commit, open_dataset
from trees import contents

from synthetless.dataset.labels import is_half_labelled
from synthetless.dataset.records import read_scene_json
from synthetless.dataset.relabel import relabel
from synthetless.dataset.store import DatasetStore
from synthetless.io.files import LockedError, locked, read_json
from synthetless.io.models import ObjectModel, load_models
from synthetless.symmetry import SymmetryTable

OBJECTS = (18, 25, 27, 30, 32)
"""Of the built-in parts: C1, C2 about an axis off the origin, C4, SO(2), D4."""
SPLIT = "train_synthetless"
LABELS = [f"{SPLIT}/{scene:06d}/scene_gt_canonical.json" for scene in (1, 2, 3)]
MAY_CHANGE = {*LABELS, "symmetries.json", "dataset.json"}


@pytest.fixture(scope="session")
def models(builtin_models: Path) -> dict[int, ObjectModel]:
    return load_models(builtin_models, OBJECTS)


@pytest.fixture(scope="session")
def original(models: dict[int, ObjectModel], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset as generate leaves it, in three scene folders."""
    root = tmp_path_factory.mktemp("original") / "d"
    dataset = open_dataset(root, models)
    commit(dataset, OBJECTS)
    dataset.assemble()
    return root


@pytest.fixture
def root(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "d"))


def _table(folder: Path, text: str) -> Path:
    path = folder / "table.yaml"
    path.write_text(text)
    return path


def _entries(root: Path) -> list[tuple[int, str]]:
    """Object and text of every label, in the files' order."""
    texts = [(root / path).read_text() for path in LABELS]
    pieces = [piece for text in texts for piece in text.split("{")[2:]]
    return [(int(piece.split('"obj_id": ')[1].split(",")[0]), piece.split("}")[0]) for piece in pieces]


@pytest.mark.parametrize("scheme", ["pitteri2019", "atlas"])
def test_the_files_are_those_that_assembling_would_have_written(
    root: Path, models: dict[int, ObjectModel], tmp_path: Path, scheme: str
) -> None:
    text = f"""
        scheme: {scheme}
        object 25: {{group: C3, axis: [1, 1, 0], offset: [0, 2, 5]}}
        obj_000027: O
        32: {{group: D2, frame: [0, 1, 0, 0, 0, 1, 1, 0, 0]}}
    """
    relabel(root, _table(tmp_path, text), workers=1)
    fresh = open_dataset(tmp_path / "fresh", models)
    shutil.copy(root / "symmetries.json", tmp_path / "fresh" / "symmetries.json")
    commit(fresh, OBJECTS)
    fresh.assemble()
    assert contents(root) == contents(tmp_path / "fresh")


def test_nothing_else_is_touched(root: Path, tmp_path: Path) -> None:
    before = contents(root)
    times = {path: path.stat().st_mtime_ns for path in root.rglob("*") if path.is_file()}
    relabel(root, _table(tmp_path, "25: C1"), workers=1)
    after = contents(root)
    assert {name for name in before if before[name] != after[name]} == MAY_CHANGE
    assert after.keys() == before.keys()
    touched = {str(path.relative_to(root)) for path, written in times.items() if path.stat().st_mtime_ns != written}
    assert touched == MAY_CHANGE


def test_back_and_forth_gives_the_same_files(root: Path, tmp_path: Path) -> None:
    before, symmetries = contents(root), tmp_path / "before.json"
    shutil.copy(root / "symmetries.json", symmetries)
    assert json.loads(symmetries.read_text())["objects"]["25"]["group"] == "C2"
    relabel(root, _table(tmp_path, "25: C1"), workers=1)
    assert contents(root) != before
    relabel(root, symmetries, workers=1)
    assert contents(root) == before
    relabel(root, scheme="atlas", workers=1)
    assert SymmetryTable.read(root / "symmetries.json").scheme == "atlas"
    relabel(root, scheme="pitteri2019", workers=1)
    assert contents(root) == before


def test_a_quasi_symmetry_changes_no_label_and_can_be_taken_back(root: Path, tmp_path: Path) -> None:
    before, symmetries = contents(root), tmp_path / "before.json"
    shutil.copy(root / "symmetries.json", symmetries)
    larger = json.loads(symmetries.read_text())
    entry = larger["objects"]["25"]
    entry["quasi"] = {"group": "C4", "axis": entry["axis"], "offset_mm": entry["offset_mm"], "tolerance_mm": 2}
    (tmp_path / "larger.json").write_text(json.dumps(larger))
    relabel(root, tmp_path / "larger.json", workers=1)
    after = contents(root)
    assert {name for name in before if before[name] != after[name]} == {"symmetries.json", "dataset.json"}
    quasi = SymmetryTable.read(root).entries[25].quasi
    assert quasi is not None and (quasi.group.name, quasi.tolerance_mm) == ("C4", 2)
    relabel(root, workers=1)
    assert contents(root) == after
    relabel(root, symmetries, workers=1)
    assert contents(root) == before


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from(["C2", "C5", "SO(2)", "O(2)"]),
    st.tuples(*3 * [st.floats(-1, 1, allow_subnormal=False)]).filter(lambda axis: max(map(abs, axis)) > 1e-3),
    st.tuples(*3 * [st.floats(-50, 50)]),
    st.sampled_from(["pitteri2019", "atlas"]),
)
def test_any_axis_and_offset_come_back_to_the_bit(
    root: Path, tmp_path: Path, group: str, axis: tuple[float, ...], offset: tuple[float, ...], scheme: str
) -> None:
    entry = {"group": group, "axis": axis, "offset": offset}
    table = _table(tmp_path, json.dumps({"scheme": scheme, "objects": {"25": entry}}))
    relabel(root, table, workers=1)
    there = contents(root)
    assert (
        read_json(root / "dataset.json")["symmetries"]["sha256"]
        == SymmetryTable.read(root / "symmetries.json").digest()
    )
    shutil.copy(root / "symmetries.json", tmp_path / "own.json")
    relabel(root, _table(tmp_path, "25: C1"), workers=1)
    relabel(root, tmp_path / "own.json", workers=1)
    assert contents(root) == there
    relabel(root, workers=1)
    assert contents(root) == there


def test_only_the_affected_objects_are_made_anew(root: Path, tmp_path: Path) -> None:
    """A label of another object that is changed by hand is still there afterwards."""
    path = root / LABELS[0]
    path.write_text(
        path.read_text().replace('"obj_id": 27, "regressor_index": 0', '"obj_id": 27, "regressor_index": 1')
    )
    before = _entries(root)
    relabel(root, _table(tmp_path, "25: {group: C2, axis: [0, 1, 0]}"), workers=1)
    after = _entries(root)
    assert {obj_id for obj_id, _ in before} == set(OBJECTS)
    assert [obj_id for obj_id, _ in before] == [obj_id for obj_id, _ in after]
    for (obj_id, old), (_, new) in zip(before, after, strict=True):
        assert (old == new) == (obj_id != 25)
    relabel(root, workers=1)
    assert _entries(root) != after, "without symmetries and scheme all labels are made anew"


def test_the_scheme_is_the_tables_or_stays(root: Path, tmp_path: Path) -> None:
    def scheme() -> str:
        return str(read_json(root / "dataset.json")["symmetries"]["scheme"])

    relabel(root, _table(tmp_path, "scheme: atlas\n25: C1"), workers=1)
    assert scheme() == "atlas"
    relabel(root, _table(tmp_path, "25: C2"), workers=1)
    assert scheme() == "atlas"
    relabel(root, _table(tmp_path, "scheme: atlas\n25: C2"), "pitteri2019", workers=1)
    assert scheme() == "pitteri2019"
    assert read_json(root / "dataset.json")["recipe"]["labels"]["scheme"] == "pitteri2019"


def test_a_dry_run_tells_what_then_happens(root: Path, tmp_path: Path) -> None:
    before, labels = contents(root), _labels(root)
    table = _table(tmp_path, "25: C1\n27: C2")
    told = relabel(root, table, dry_run=True, workers=1)
    assert contents(root) == before
    assert relabel(root, table, workers=1) == told
    assert (told.scenes, told.images, told.scheme_before, told.scheme_after) == (3, 6, "pitteri2019", "pitteri2019")
    none, half = told.objects
    assert (none.obj_id, none.group_before, none.group_after) == (25, "C2", "C1")
    assert (half.obj_id, half.group_before, half.group_after) == (27, "C4", "C2")
    assert (none.n_regressors_before, none.n_regressors_after) == (2, 1)
    changes = [(old, new) for old, new in zip(labels, _labels(root), strict=True) if old["obj_id"] == 25]
    assert none.tally.instances == none.tally.changed == len(changes) > 5
    assert none.tally.index_changed == sum(old["regressor_index"] for old, _ in changes) > 0
    assert none.tally.max_rotation_deg == pytest.approx(180), "C2 turns by half turns"
    assert half.tally.max_rotation_deg in (pytest.approx(90), pytest.approx(180))
    assert f"object 25: C2 -> C1, regressors 2 -> 1; {len(changes)} of {len(changes)} instances change" in str(told)
    again = relabel(root, table, dry_run=True, workers=1)
    assert again.objects == (), "nothing is left to do"


def _labels(root: Path) -> list[dict[str, float]]:
    return [label for path in LABELS for entries in read_scene_json(root / path).values() for label in entries]


def test_an_edited_symmetries_json_takes_effect(root: Path, models: dict[int, ObjectModel], tmp_path: Path) -> None:
    """By relabelling, and by going on with the dataset: neither lets labels of the former table stand."""
    table = json.loads((root / "symmetries.json").read_text())
    table["objects"]["27"] = {"group": "C2"}
    (root / "symmetries.json").write_text(json.dumps(table))
    other = Path(shutil.copytree(root, tmp_path / "other"))
    relabel(root, workers=1)
    assert all(label["n_regressors"] == 2 for label in _labels(root) if label["obj_id"] == 27)
    open_dataset(other, models).assemble()
    assert [_labels(other), read_json(other / "dataset.json")] == [_labels(root), read_json(root / "dataset.json")]


def test_labels_that_are_lost_or_damaged_are_made_anew(root: Path, tmp_path: Path) -> None:
    before = contents(root)
    (root / LABELS[0]).unlink()
    (root / LABELS[1]).write_bytes(before[LABELS[1]][:-200])
    (root / LABELS[2]).write_text('{"0": [{"obj_id": 1}]}')
    relabel(root, scheme="pitteri2019", workers=1)
    assert contents(root) == before


def test_several_processes_write_the_same(root: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(root, tmp_path / "other"))
    table = _table(tmp_path, "scheme: atlas\n25: C1")
    assert relabel(root, table, workers=2) == relabel(other, table, workers=1)
    assert contents(root) == contents(other)


def test_a_dataset_grows_with_its_new_symmetries(root: Path, models: dict[int, ObjectModel], tmp_path: Path) -> None:
    relabel(root, _table(tmp_path, "scheme: atlas\n25: C1"), workers=1)
    more = open_dataset(root, models, 2003)
    commit(more, OBJECTS, [3, 2002])
    more.assemble()
    fresh = open_dataset(tmp_path / "fresh", models, 2003)
    shutil.copy(root / "symmetries.json", tmp_path / "fresh" / "symmetries.json")
    commit(fresh, OBJECTS, [0, 1, 2, 3, 1000, 1001, 2000, 2002])
    fresh.assemble()
    assert contents(root) == contents(tmp_path / "fresh")


def test_a_dataset_without_images_takes_symmetries(models: dict[int, ObjectModel], tmp_path: Path) -> None:
    root = tmp_path / "d"
    dataset = open_dataset(root, models)
    relabel(root, _table(tmp_path, "25: C1"), workers=1)
    commit(dataset, OBJECTS)
    dataset.assemble()
    assert {label["n_regressors"] for label in _labels(root) if label["obj_id"] == 25} == {1}


# What must be refused


WRONG_TABLES = {
    "99: C2": r"table\.yaml: object 99 is none of the dataset's objects 18, 25, 27, 30, 32",
    "25: {group: C2, axis: [0, 0, 0]}": "object 25: .*axis is zero",
    "25: {group: C0}": "object 25: .*C0",
    "25: {group: C2, frame: [1, 0, 0, 0, 1, 0, 0, 0, -1]}": "object 25: .*reflection",
    "25: {symmetries_discrete: [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]]}": "object 25: .*reflection",
    "25: {grup: C2}": "did you mean 'group'",
    "scheme: atlsa": "unknown scheme 'atlsa'",
    "25: [": "neither JSON nor YAML",
    "- 25": "is a mapping of objects",
}


@pytest.mark.parametrize("text", WRONG_TABLES)
def test_wrong_symmetries_leave_the_dataset_alone(root: Path, tmp_path: Path, text: str) -> None:
    _assert_refused(root, lambda: relabel(root, _table(tmp_path, text), workers=1), WRONG_TABLES[text])


def test_an_unknown_scheme_and_a_missing_table_are_refused(root: Path, tmp_path: Path) -> None:
    _assert_refused(root, lambda: relabel(root, scheme="none", workers=1), "unknown scheme 'none'")  # type: ignore[arg-type]
    _assert_refused(root, lambda: relabel(root, tmp_path / "no.yaml", workers=1), r"no\.yaml: not found")


DAMAGE = {
    f"{SPLIT}/000003/scene_gt.json": r"000003/scene_gt\.json: not valid JSON, cut off or damaged",
    f"{SPLIT}/000002/scene_camera.json": r"000002/scene_camera\.json: not valid JSON, cut off or damaged",
    "dataset.json": r"dataset\.json: not valid JSON",
    "symmetries.json": r"symmetries\.json: ",
    "models/models_info.json": r"models_info\.json: not valid JSON",
}


@pytest.mark.parametrize(("name", "workers"), [(name, 1) for name in DAMAGE] + [(next(iter(DAMAGE)), 2)])
def test_a_damaged_dataset_is_left_alone(root: Path, name: str, workers: int) -> None:
    (root / name).write_bytes((root / name).read_bytes()[:-40])
    _assert_refused(root, lambda: relabel(root, scheme="atlas", workers=workers), DAMAGE[name])


@pytest.mark.parametrize("name", [name for name in DAMAGE if name != "dataset.json"])
def test_a_missing_file_is_named(root: Path, name: str) -> None:
    (root / name).unlink()
    _assert_refused(
        root, lambda: relabel(root, scheme="atlas", workers=1), f"{Path(name).name}: (not found|cannot be read)"
    )


def test_a_damaged_recipe_is_told_before_anything_is_written(root: Path) -> None:
    header = read_json(root / "dataset.json")
    header["recipe"]["camera"]["width"] = "wide"
    (root / "dataset.json").write_text(json.dumps(header))
    _assert_refused(root, lambda: relabel(root, scheme="atlas", workers=1), r"dataset\.json: its recipe is damaged")


def test_a_pose_that_is_none_is_named(root: Path) -> None:
    path = root / SPLIT / "000002" / "scene_gt.json"
    gt = read_json(path)
    gt["1"][4]["cam_R_m2c"][0] += 0.5
    path.write_text(json.dumps(gt))
    _assert_refused(
        root, lambda: relabel(root, scheme="atlas", workers=1), r"000002: scene_gt\.json: image 1, instance 4: "
    )


def test_what_is_no_dataset_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("dear")
    _assert_refused(tmp_path, lambda: relabel(tmp_path), r"holds no dataset\.json")


def test_a_dataset_at_work_is_left_alone(root: Path, models: dict[int, ObjectModel]) -> None:
    with locked(root), pytest.raises(LockedError, match="another synthetless is writing"):
        relabel(root, scheme="atlas", workers=1)


def test_a_full_disk_leaves_the_dataset_alone(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """/dev/full refuses every byte, as a full disk does."""

    def write(path: Path, data: bytes, durable: bool = False) -> None:
        with Path("/dev/full").open("wb", buffering=0) as file:
            file.write(data)

    monkeypatch.setattr("synthetless.dataset.relabel.atomic_write", write)
    _assert_refused(
        root, lambda: relabel(root, scheme="atlas", workers=1), "cannot be written .No space left on device."
    )


def _assert_refused(root: Path, call: Callable[[], object], message: str) -> None:
    before = contents(root)
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert "\n" not in str(error.value)
    assert contents(root) == before
    assert not [path for path in root.rglob("*") if "relabel" in path.name or path.name == ".symmetries.json"]


# What must survive a kill


@pytest.fixture(scope="session")
def relabelled(original: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the dataset is to become."""
    root = Path(shutil.copytree(original, tmp_path_factory.mktemp("relabelled") / "d"))
    relabel(root, scheme="atlas", workers=1)
    return root


def _in_child(work: Callable[[], object]) -> multiprocessing.process.BaseProcess:
    child = multiprocessing.get_context("fork").Process(target=work)
    child.start()
    return child


def _judge(root: Path, before: dict[str, bytes], after: dict[str, bytes]) -> str:
    """Every file is whole and either old or new; together they are old or new, unless they are known to be mixed."""
    found = {
        name: data
        for name, data in contents(root).items()
        if not name.startswith((".relabel", ".symmetries.json")) and ".lock" not in name
    }
    assert found.keys() == before.keys()
    for name, data in found.items():
        assert data in (before[name], after[name])
    if is_half_labelled(root):
        return "half"
    assert found in (before, after)
    return "old" if found == before else "new"


def test_kills_at_random_moments_lose_nothing(original: Path, relabelled: Path, tmp_path: Path) -> None:
    before, after = contents(original), contents(relabelled)
    timed = Path(shutil.copytree(original, tmp_path / "timed"))
    start = time.perf_counter()
    child = _in_child(partial(relabel, timed, scheme="atlas", workers=1))
    child.join()
    duration_s = time.perf_counter() - start
    chance = random.Random(0)
    for number in range(20):
        root = Path(shutil.copytree(original, tmp_path / f"{number}"))
        child = _in_child(partial(relabel, root, scheme="atlas", workers=1))
        time.sleep(chance.uniform(0, 1.2 * duration_s))
        child.kill()
        child.join()
        _judge(root, before, after)
        relabel(root, scheme="atlas", workers=1)
        assert contents(root) == after


def test_a_kill_before_any_change_on_disk_loses_nothing(
    original: Path, relabelled: Path, models: dict[int, ObjectModel], tmp_path: Path
) -> None:
    """Killed before its 1st, 2nd, ... step that writes; then relabelled again, or gone on with by generate."""
    before, after = contents(original), contents(relabelled)
    seen = []
    for step in range(1, 200):
        root = Path(shutil.copytree(original, tmp_path / f"{step}"))
        child = _in_child(partial(_killed_at, step, root))
        child.join()
        seen.append(_judge(root, before, after))
        other = Path(shutil.copytree(root, tmp_path / f"{step}o"))
        DatasetStore.assemble(open_dataset(other, models))
        continued = {name: data for name, data in contents(other).items() if ".lock" not in name}
        assert continued == (before if seen[-1] == "old" else after)
        if seen[-1] == "half":
            with pytest.raises(ValueError, match="half relabelled"):
                relabel(root, dry_run=True)
            relabel(root, scheme="pitteri2019", workers=1)
            assert contents(root) == before, "what was begun is completed, then undone"
        relabel(root, scheme="atlas", workers=1)
        assert contents(root) == after
        if child.exitcode == 0:
            break
    assert child.exitcode == 0
    assert seen == sorted(seen, key=["old", "half", "new"].index)
    assert min(seen.count("old"), seen.count("half")) >= 5
    assert seen.count("new") >= 2


def _killed_at(step: int, root: Path) -> None:
    count = 0

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal count
        writes = event in ("os.rename", "os.mkdir", "os.remove", "os.rmdir")
        if writes or (event == "open" and "w" in str(arguments[1])):
            count += 1
            if count == step:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    relabel(root, scheme="atlas", workers=1)


def test_workers_of_a_killed_relabelling_do_no_harm(original: Path, relabelled: Path, tmp_path: Path) -> None:
    """The lock is free at once, and the orphans end."""
    root = Path(shutil.copytree(original, tmp_path / "d"))
    script = tmp_path / "script.py"
    script.write_text(f"""
from pathlib import Path
import synthetless.dataset.relabel
from synthetless.dataset.relabel import relabel

if __name__ == "__main__":
    synthetless.dataset.relabel.atomic_write = lambda *given, **how: (print("a scene is labelled", flush=True), input())
    relabel(Path({str(root)!r}), scheme="atlas", workers=2)
""")
    environment, pipe = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2] / "src")}, subprocess.PIPE
    process = subprocess.Popen([sys.executable, script], stdin=pipe, stdout=pipe, env=environment)
    assert process.stdout is not None
    assert process.stdout.readline() == b"a scene is labelled\n"
    process.kill()
    process.wait()
    assert _judge(root, contents(original), contents(relabelled)) == "old"
    relabel(root, scheme="atlas", workers=1)
    assert contents(root) == contents(relabelled)
    assert process.stdout.read() == b"", "its end is seen when no worker holds it any more"


# What an attacker may have planted


def _planted(root: Path, outside: Path, kind: str) -> None:
    match kind:
        case "folder of an older protocol":
            (root / ".relabel").mkdir()
            (root / ".relabel" / "link").symlink_to(outside)
            (root / ".relabel" / "dataset.json").write_text("{}")
            (root / "link").symlink_to(outside)
        case "draft that is a link":
            (root / ".relabel.draft").symlink_to(outside)
        case "draft with links":
            (root / ".relabel.draft").mkdir()
            (root / ".relabel.draft" / "link").symlink_to(outside)
        case "labels that are a link":
            path = root / SPLIT / "000001" / "scene_gt_canonical.json"
            path.unlink()
            path.symlink_to(outside / "victim.txt")
        case "table that is a link":
            text = (root / "symmetries.json").read_text()
            (root / "symmetries.json").unlink()
            (outside / "table.json").write_text(text)
            (root / "symmetries.json").symlink_to(outside / "table.json")
        case "pending table that is a link":
            (outside / "table.json").write_text((root / "symmetries.json").read_text())
            (root / ".symmetries.json").symlink_to(outside / "table.json")
        case "lock that is a link":
            (root / ".synthetless.lock").symlink_to(outside / "victim.txt")


@pytest.mark.parametrize(
    "kind",
    [
        "folder of an older protocol",
        "draft that is a link",
        "draft with links",
        "labels that are a link",
        "table that is a link",
        "pending table that is a link",
        "lock that is a link",
    ],
)
@pytest.mark.parametrize("command", ["relabel", "assemble"])
def test_nothing_outside_is_written(
    root: Path, models: dict[int, ObjectModel], tmp_path: Path, kind: str, command: str
) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "victim.txt").write_text("dear")
    _planted(root, outside, kind)
    before = contents(outside)
    try:
        if command == "relabel":
            relabel(root, scheme="atlas", workers=1)
        else:
            open_dataset(root, models).finish()
    except ValueError as error:
        assert "\n" not in str(error)
    assert contents(outside) == before
