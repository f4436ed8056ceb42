"""Where exports and previews may be written: never over the dataset, never over what they did not write."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from trees import contents

from synthetless.config import SPLIT
from synthetless.errors import UserError
from synthetless.exports.bop import BopExport
from synthetless.exports.coco import export_coco
from synthetless.exports.folder import write_export
from synthetless.exports.webdataset import export_webdataset, relabel_webdataset
from synthetless.exports.yolo import export_yolo
from synthetless.io.files import atomic_folder

Export = Callable[[Path, Path], object]

EXPORTS: dict[str, Export] = {
    "coco": export_coco,
    "webdataset": lambda dataset, to: export_webdataset(dataset, to, workers=1),
    "bop": lambda dataset, to: write_export(BopExport(dataset, SPLIT), to, workers=1),
    "yolo": lambda dataset, to: export_yolo(dataset, to, workers=1),
    "relabel": lambda dataset, to: relabel_webdataset(dataset, to, workers=1),
}
BELONGS = "belongs to the dataset|holds the dataset"
SCENE = "train_synthetless/000001"


@pytest.fixture
def copy(dataset: Path, tmp_path: Path) -> Path:
    root = shutil.copytree(dataset, tmp_path / "z")
    (root / "models").mkdir()
    (root / ".records" / "000001").mkdir(parents=True)
    return root


@pytest.mark.parametrize("export", EXPORTS)
@pytest.mark.parametrize(
    "place",
    [
        "",
        "..",
        "../..",
        "dataset.json",
        "symmetries.json",
        ".symmetries.json",
        "camera.json",
        "README.md",
        "preview.jpg",
        "preview",
        "preview/coco.json",
        "models",
        "models/coco.json",
        "models_cad/new",
        ".records/000001/000000.json",
        ".hidden",
        "train_synthetless",
        "train_synthetless/new",
        SCENE,
        f"{SCENE}/scene_gt_coco.json",
        f"{SCENE}/rgb/000000.png",
        f"{SCENE}/new.json",
        f"./{SCENE}/../000002/new",
        f"../z/{SCENE}/new",
    ],
)
def test_nothing_of_the_dataset_is_replaced(copy: Path, export: str, place: str) -> None:
    before = contents(copy)
    with pytest.raises(UserError, match=BELONGS):
        EXPORTS[export](copy, copy / place)
    assert contents(copy) == before


@pytest.mark.parametrize("export", EXPORTS)
def test_links_are_followed_before_they_are_judged(copy: Path, tmp_path: Path, export: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    shutil.move(copy / SCENE, elsewhere)
    (copy / SCENE).symlink_to(elsewhere)
    (tmp_path / "alias").symlink_to(copy)
    (tmp_path / "file").symlink_to(copy / "dataset.json")
    (tmp_path / "loop").symlink_to("loop")
    before = contents(copy)
    for target in (elsewhere / "new", tmp_path / "alias" / "models" / "new", tmp_path / "alias", tmp_path / "file"):
        with pytest.raises(UserError, match=BELONGS):
            EXPORTS[export](copy, target)
    with pytest.raises(UserError, match="loop: cannot be followed"):
        EXPORTS[export](copy, tmp_path / "loop")
    assert contents(copy) == before


@pytest.mark.parametrize("place", ["coco.json", "annotations/train.json", "../coco.json", "mine/coco.json"])
def test_a_free_name_is_written_and_written_again(copy: Path, place: str) -> None:
    (copy / "mine").mkdir()
    assert export_coco(copy, copy / place) == export_coco(copy, copy / place, boxes="amodal") == 6


@pytest.mark.parametrize(
    "content",
    [b"", b"{}", b'{"info": {}}', b"notes", b"\0\xff", b'{\n"info": {"description": "mine"}', b"{\n" + b" " * 9000],
)
def test_a_file_that_is_no_export_is_kept(copy: Path, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mine.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"mine\.json: exists already and is not a COCO export"):
        export_coco(copy, path)
    assert path.read_bytes() == content


@pytest.mark.parametrize("kind", ["folder", "fifo", "device"])
def test_what_is_no_file_is_refused(copy: Path, tmp_path: Path, kind: str) -> None:
    path = tmp_path / kind
    if kind == "folder":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path = Path(os.devnull)
    with pytest.raises(UserError, match="exists already and is not a COCO export"):
        export_coco(copy, path)


def test_images_are_found_from_a_file_that_a_link_leads_to(copy: Path, tmp_path: Path) -> None:
    """A path with .. in it starts from where the file is, not from where the link to it is."""
    deep = tmp_path / "a" / "b" / "c"
    deep.mkdir(parents=True)
    (tmp_path / "link").symlink_to(deep)
    export_coco(copy, tmp_path / "link" / "coco.json")

    image = json.loads((deep / "coco.json").read_text())["images"][0]
    assert (deep / image["file_name"]).is_file()


def test_two_exports_to_one_target_do_not_disturb_each_other(dataset: Path, tmp_path: Path) -> None:
    """The folder of the one that ends first is whole; the other one says that it is there."""
    both = (
        "import sys, time\nfrom pathlib import Path\nfrom synthetless.errors import UserError\n"
        "from synthetless.io.files import atomic_folder\n"
        "me, other, to = sys.argv[1], *map(Path, sys.argv[2:])\n"
        "try:\n"
        "    with atomic_folder(to) as folder:\n"
        "        (folder / 'who').write_text(me)\n"
        "        to.with_name(me).touch()\n"
        "        while not other.exists(): time.sleep(0.01)\n"
        "        assert (folder / 'who').read_text() == me\n"
        "except UserError as error: print(error)\n"
    )
    to = tmp_path / "shards"
    running = [
        subprocess.Popen(
            [sys.executable, "-c", both, me, str(tmp_path / other), str(to)], stdout=subprocess.PIPE, text=True
        )
        for me, other in (("a", "b"), ("b", "a"))
    ]
    said = [process.communicate(timeout=60)[0] for process in running]
    assert [process.returncode for process in running] == [0, 0]
    assert sorted(map(bool, said)) == [False, True]
    assert "shards: cannot be written (Directory not empty)" in "".join(said)
    assert (to / "who").read_text() == "ab"[said.index("")]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "shards"]


def _draft(name: str, pid: int) -> str:
    return f".{name}.{socket.gethostname()}.{pid}.part"


@pytest.fixture
def dead() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_new_export_removes_what_a_killed_one_left(dataset: Path, tmp_path: Path, dead: int) -> None:
    kept = [_draft("shards", os.getppid()), _draft("other", dead), ".shards.elsewhere.7.part", "shards.part"]
    for name in (*kept, _draft("coco.json", dead)):
        (tmp_path / name).write_text("half")
    for name in (_draft("shards", dead), _draft("shards", dead).replace(".part", ".former.part")):
        (tmp_path / name / "inside").mkdir(parents=True)
    export_webdataset(dataset, tmp_path / "shards", workers=1)
    export_coco(dataset, tmp_path / "coco.json")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*kept, "shards", "coco.json"])


def test_relabelling_removes_what_a_killed_one_left(dataset: Path, tmp_path: Path) -> None:
    export_webdataset(dataset, tmp_path / "shards", images_per_shard=1, workers=1)
    before = contents(tmp_path / "shards")
    slow = (
        "import sys, time\nfrom pathlib import Path\nfrom synthetless.exports import webdataset\n"
        "read = webdataset._read_tar\n"
        "def _read_tar(path):\n"
        "    yield from read(path)\n"
        "    print('half', flush=True); time.sleep(60)\n"
        "webdataset._read_tar = _read_tar\n"
        "webdataset.relabel_webdataset(Path(sys.argv[1]), Path(sys.argv[2]), workers=1)\n"
    )
    arguments = [sys.executable, "-c", slow, str(dataset), str(tmp_path / "shards")]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "half\n"
        process.kill()
    left = contents(tmp_path / "shards")
    assert any(str(name).endswith(".part") for name in left)
    assert "key_to_shard.json" not in {str(name) for name in left}
    relabel_webdataset(dataset, tmp_path / "shards", workers=1)
    assert contents(tmp_path / "shards") == before


def test_a_folder_is_exchanged_only_when_the_new_one_is_whole(tmp_path: Path) -> None:
    to = tmp_path / "pages"
    for number in range(2):
        with atomic_folder(to, replace=True) as folder:
            (folder / str(number)).touch()
    assert [path.name for path in to.iterdir()] == ["1"]
    with pytest.raises(KeyboardInterrupt), atomic_folder(to, replace=True) as folder:
        (folder / "2").touch()
        raise KeyboardInterrupt
    assert [path.name for path in to.iterdir()] == ["1"]
    assert [path.name for path in tmp_path.iterdir()] == ["pages"]
