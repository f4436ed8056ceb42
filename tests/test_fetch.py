"""Fetching: the right files, checked, whole or not at all; and archives that mean harm."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import re
import shutil
import stat
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fetch_server import QUICK, Server, break_off, fail, files_of_at_most, redirect, running
from hypothesis import given, settings
from hypothesis import strategies as st

from synthetless.fetch import (
    DTD,
    TLESS,
    TLESS_DIAMETERS_MM,
    ArchiveError,
    DataSource,
    DownloadError,
    FetchReport,
    Limits,
    Member,
    check_dtd,
    fetch,
    obtain,
    open_archive,
    unpack,
)
from synthetless.io.models import load_models

MB = 1_000_000


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with running() as made:
        yield made


def _box(diameter: float) -> tuple[bytes, dict[str, float]]:
    """A box of the given diameter and its entry in models_info.json."""
    sides = np.array([3.0, 2.0, 1.0]) / np.sqrt(14) * diameter
    info = {f"{name}_{axis}": value for axis, s in zip("xyz", sides, strict=True) for name, value in _extent(s)}
    return trimesh.creation.box(sides).export(file_type="ply"), {"diameter": diameter, **info}


def _extent(side: float) -> tuple[tuple[str, float], ...]:
    return ("min", -side / 2), ("size", side)


def tless_files(diameters_mm: tuple[float, ...] = TLESS_DIAMETERS_MM) -> dict[str, bytes]:
    """Boxes with the diameters of T-LESS, laid out as in BOP's archive, with what else that holds."""
    boxes = {obj_id: _box(diameter) for obj_id, diameter in enumerate(diameters_mm, start=1)}
    info = json.dumps({str(obj_id): entry for obj_id, (_, entry) in boxes.items()}).encode()
    files = {f"models_cad/obj_{obj_id:06d}.ply": mesh for obj_id, (mesh, _) in boxes.items()} | {
        "models_cad/models_info.json": info
    }
    others = {name.replace("_cad", kind): b"not wanted" for name in files for kind in ("_eval", "_reconst")}
    return others | files


def dtd_files() -> dict[str, bytes]:
    images = {
        f"dtd/images/category{category:02d}/category{category:02d}_{number:04d}.jpg": b"\xff\xd8\xff"
        + bytes([category])
        for category in range(47)
        for number in range(120)
    }
    return images | {
        "dtd/images/category03/.directory": b"KDE's",
        "dtd/labels/train1.txt": b"x",
        "dtd/imdb/i.mat": b"y",
    }


def zipped(
    files: Mapping[str, bytes], compression: int = zipfile.ZIP_DEFLATED, extra: tuple[zipfile.ZipInfo, ...] = ()
) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", compression) as archive:
        for info in extra:
            archive.writestr(info, b"/etc/passwd")
        for name, content in files.items():
            archive.writestr(name, content)
    return data.getvalue()


def tarred(files: Mapping[str, bytes], mode: str = "w:gz", extra: tuple[tarfile.TarInfo, ...] = ()) -> bytes:
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode=mode) as archive:  # type: ignore[call-overload]
        for info in extra:
            archive.addfile(info)
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return data.getvalue()


@pytest.fixture(scope="module")
def tless_zip() -> bytes:
    return zipped(tless_files())


@pytest.fixture(scope="module")
def dtd_tar() -> bytes:
    return tarred(dtd_files())


@pytest.fixture(scope="module")
def dtd_folder(dtd_tar: bytes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dtd")
    (folder / "dtd.tgz").write_bytes(dtd_tar)
    assert fetch("dtd", folder / "to", str(folder / "dtd.tgz")).files == 5640
    return folder / "to"


def published(data: DataSource, server: Server, content: bytes) -> DataSource:
    """The data source as if the server were its publisher."""
    server.content = content
    return dataclasses.replace(data, address=server.url, sha256=hashlib.sha256(content).hexdigest())


def tree(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


TLESS_TREE = sorted(
    ["LICENCE-tless.txt", "models_cad/models_info.json", *(f"models_cad/obj_{i:06d}.ply" for i in range(1, 31))]
)


def test_tless_is_fetched_through_a_bad_line(server: Server, tless_zip: bytes, tmp_path: Path) -> None:
    data = published(TLESS, server, tless_zip)
    server.script = [fail(503), redirect("/cdn"), break_off(10_000), break_off(3_000)]
    report = obtain(data, tmp_path / "new" / "tless", persistence=QUICK)
    assert tree(tmp_path) == [f"new/tless/{name}" for name in TLESS_TREE]
    assert report.folder == tmp_path / "new" / "tless" / "models_cad"
    assert (report.files, report.fetched) == (31, True)
    assert "CC BY 4.0" in report.licence
    assert report.licence_file.read_text() == report.licence
    assert len(load_models(report.folder)) == 30


def test_what_is_there_is_not_fetched_again(server: Server, tless_zip: bytes, tmp_path: Path) -> None:
    data = published(TLESS, server, tless_zip)
    first = obtain(data, tmp_path, persistence=QUICK)
    second = obtain(data, tmp_path, persistence=QUICK)
    assert len(server.requests) == 1
    assert second == dataclasses.replace(first, fetched=False)
    assert "already there: 31 files" in str(second)


def test_a_fetch_that_was_broken_off_is_continued(server: Server, tless_zip: bytes, tmp_path: Path) -> None:
    data = published(TLESS, server, tless_zip)
    server.script = [break_off(10_000), *[break_off(0)] * QUICK.attempts]
    with pytest.raises(DownloadError, match="run it again to continue"):
        obtain(data, tmp_path, persistence=QUICK)
    obtain(data, tmp_path, persistence=QUICK)
    assert server.ranges[-1] == "bytes=10000-"
    assert tree(tmp_path) == TLESS_TREE


def test_dtd_is_taken_from_its_archive(dtd_folder: Path) -> None:
    names = tree(dtd_folder)
    assert len(names) == 5641
    assert names[:2] == ["LICENCE-dtd.txt", "images/category00/category00_0000.jpg"]
    assert "research purposes" in (dtd_folder / "LICENCE-dtd.txt").read_text()


def test_an_archive_of_another_checksum_is_refused(server: Server, tless_zip: bytes, tmp_path: Path) -> None:
    data = published(TLESS, server, tless_zip)
    server.content = zipped(tless_files(), zipfile.ZIP_STORED)
    with pytest.raises(ArchiveError, match=r"sha256 .* instead of .*--from"):
        obtain(data, tmp_path / "to", persistence=QUICK)
    assert not (tmp_path / "to").exists()
    obtain(data, tmp_path / "to", server.url, QUICK)
    assert tree(tmp_path / "to") == TLESS_TREE


def test_the_published_checksums_are_sha256() -> None:
    for data in (TLESS, DTD):
        assert re.fullmatch(r"[0-9a-f]{64}", data.sha256)
        assert data.address.startswith("https://")
        assert data.address.endswith(data.archive)


def test_garbage_from_the_server_is_refused(server: Server, tmp_path: Path) -> None:
    data = dataclasses.replace(TLESS, address=server.url)
    server.content = b"<html>please log in</html>"
    with pytest.raises(ArchiveError, match="sha256"):
        obtain(data, tmp_path / "to", persistence=QUICK)
    with pytest.raises(ArchiveError, match=r"127\.0\.0\.1.*neither a zip nor a tar archive"):
        obtain(data, tmp_path / "to", server.url, QUICK)
    assert not (tmp_path / "to").exists()


def _damaged_copies(content: bytes) -> Iterator[bytes]:
    yield content[: len(content) // 2]
    yield content[:-30]
    yield content[: len(content) // 2] + bytes(64) + content[len(content) // 2 + 64 :]


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("kind", ["zip", "tar.gz", "tar.bz2", "tar.xz"])
def test_a_damaged_archive_is_refused(kind: str, number: int, tless_zip: bytes, tmp_path: Path) -> None:
    content = tless_zip if kind == "zip" else tarred(tless_files(), f"w:{kind[4:]}")
    path = tmp_path / f"archive.{kind}"
    path.write_bytes(list(_damaged_copies(content))[number])
    with pytest.raises(ArchiveError, match=r"archive\.") as raised:
        fetch("tless", tmp_path / "to", str(path))
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "to").exists()


@given(st.binary(min_size=1, max_size=3), st.floats(0, 1, exclude_max=True), st.sampled_from(["zip", "w:gz", "w:xz"]))
@settings(max_examples=60)
def test_an_archive_with_any_bytes_changed_is_refused_or_gives_the_same(
    few_models: Mapping[str, bytes], change: bytes, place: float, kind: str
) -> None:
    content = bytearray(few_models[kind])
    start = int(place * (len(content) - len(change)))
    content[start : start + len(change)] = change
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "archive"
        path.write_bytes(content)
        try:
            with open_archive(path) as members:
                unpack(members, TLESS.wanted, Path(folder), TLESS.limits)
        except ArchiveError:
            return
        whole = {f"models_cad/{file.name}": file.read_bytes() for file in Path(folder).iterdir() if file != path}
    assert whole.items() <= tless_files().items()


@pytest.fixture(scope="module")
def few_models() -> dict[str, bytes]:
    """Archives of two models, by kind."""
    files = {name: content for name, content in tless_files().items() if re.search("_cad/obj_00001[12]", name)}
    return {"zip": zipped(files), "w:gz": tarred(files, "w:gz"), "w:xz": tarred(files, "w:xz")}


@pytest.mark.parametrize("mode", ["w", "w:gz", "w:bz2", "w:xz"])
def test_a_tar_archive_of_any_kind_will_do(mode: str, tmp_path: Path) -> None:
    path = tmp_path / "archive"
    path.write_bytes(tarred(tless_files(), mode))
    assert fetch("tless", tmp_path / "to", str(path)).files == 31
    assert path.exists(), "the user's own archive stays"


def test_an_archive_with_a_password_is_refused(tless_zip: bytes, tmp_path: Path) -> None:
    content = bytearray(tless_zip)
    for start in [match.start() for match in re.finditer(b"PK\x01\x02", tless_zip)]:
        content[start + 8] |= 1  # the general purpose flag of the central directory: encrypted
    (tmp_path / "locked.zip").write_bytes(content)
    with pytest.raises(ArchiveError, match="encrypted"):
        fetch("tless", tmp_path / "to", str(tmp_path / "locked.zip"))


@pytest.mark.parametrize("inside", ["", "models_cad", "tless/models_cad", "a/b/models_cad"])
def test_a_folder_is_copied(inside: str, tmp_path: Path) -> None:
    for name, content in tless_files().items():
        if name.startswith("models_cad/"):
            path = tmp_path / "from" / inside / Path(name).name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    fetch("tless", tmp_path / "to", str(tmp_path / "from"))
    assert tree(tmp_path / "to") == TLESS_TREE


def test_models_are_copied_out_of_a_whole_dataset(tmp_path: Path) -> None:
    images = {f"test_primesense/000001/rgb/{number:06d}.png": b"" for number in range(100)}
    (tmp_path / "archive.zip").write_bytes(zipped(tless_files() | images))
    with zipfile.ZipFile(tmp_path / "archive.zip") as archive:
        archive.extractall(tmp_path / "tless")
    obtain(small(TLESS, files=31), tmp_path / "to", str(tmp_path / "tless"))
    assert tree(tmp_path / "to") == TLESS_TREE


def test_a_folder_of_textures_is_copied(dtd_folder: Path, tmp_path: Path) -> None:
    (dtd_folder / "images" / "category03" / ".directory").touch()  # KDE's; the real archive has one
    fetch("dtd", tmp_path, str(dtd_folder))
    assert len(tree(tmp_path)) == 5641
    assert not fetch("dtd", dtd_folder).fetched


@pytest.mark.tless
def test_the_real_models_are_recognised(tless_models: Path, tmp_path: Path) -> None:
    files = {f"models_cad/{path.name}": path.read_bytes() for path in tless_models.iterdir()}
    (tmp_path / "tless_models.zip").write_bytes(zipped(files, zipfile.ZIP_STORED))
    report = fetch("tless", tmp_path / "to", str(tmp_path / "tless_models.zip"))
    assert report.files == 31
    assert all((report.folder / path.name).read_bytes() == path.read_bytes() for path in tless_models.iterdir())


@contextmanager
def _refused(files: Mapping[str, bytes], folder: Path, match: str) -> Iterator[None]:
    path = folder / "models.zip"
    path.write_bytes(zipped(files))
    with pytest.raises(ArchiveError, match=match) as raised:
        fetch("tless", folder / "to", str(path))
    assert ".part" not in str(raised.value)
    assert not (folder / "to").exists()
    yield


def test_models_that_are_not_tless_are_refused(tmp_path: Path) -> None:
    files = tless_files()
    too_few = {name: content for name, content in files.items() if "000030" not in name}
    grown = (*TLESS_DIAMETERS_MM[:6], TLESS_DIAMETERS_MM[6] + 0.5, *TLESS_DIAMETERS_MM[7:])
    lying = tless_files(grown) | {"models_cad/models_info.json": files["models_cad/models_info.json"]}
    metres = tless_files(tuple(mm / 1000 for mm in TLESS_DIAMETERS_MM))
    with (
        _refused(too_few, tmp_path, r"models\.zip: not the T-LESS CAD models \(holds 29 models"),
        _refused(tless_files(grown), tmp_path, r"object 7: diameter 179\.115 mm by the mesh; 178\.615 mm is that"),
        _refused(lying, tmp_path, r"object 7|obj_000007"),
        _refused(metres, tmp_path, r"object 1: diameter 0\.064 mm"),
        _refused(files | {"models_cad/obj_000004.ply": b"ply\n"}, tmp_path, r"\(obj_000004\.ply: cut off"),
        _refused(files | {"models_cad/models_info.json": b"{}"}, tmp_path, "no entry for object 1"),
        _refused({"readme.txt": b"hello"}, tmp_path, "nothing of the T-LESS CAD models in it"),
    ):
        pass


def test_a_mesh_that_contradicts_models_info_is_refused(tmp_path: Path) -> None:
    """The same diameter as an entry is not enough: it is measured."""
    files = tless_files()
    files["models_cad/obj_000007.ply"] = _box(TLESS_DIAMETERS_MM[6] + 0.02)[0]
    with _refused(files, tmp_path, r"object 7: diameter 178\.635 mm by the mesh"):
        pass


def test_textures_that_are_not_dtd_are_refused(dtd_folder: Path) -> None:
    images = dtd_folder / "images"
    image = images / "category04" / "category04_0007.jpg"
    content = image.read_bytes()
    image.unlink()
    with pytest.raises(ArchiveError, match=r"not the Describable .* \(category category04 has 119 images"):
        fetch("dtd", dtd_folder)
    image.touch()
    with pytest.raises(ValueError, match=r"1 images are empty, category04/category04_0007\.jpg"):
        check_dtd(images)
    image.write_bytes(content)
    (images / "category46").rename(dtd_folder / "category46")
    with pytest.raises(ValueError, match="holds 46 categories"):
        check_dtd(images)
    (dtd_folder / "category46").rename(images / "category46")


def test_something_else_in_the_place_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "models_cad").mkdir()
    (tmp_path / "models_cad" / "mine.txt").write_text("mine")
    with pytest.raises(ArchiveError, match=r"there already, but not the T-LESS CAD models .*; remove it"):
        fetch("tless", tmp_path)
    assert tree(tmp_path) == ["models_cad/mine.txt"]


def test_a_target_that_is_a_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ArchiveError, match="cannot be made a folder"):
        fetch("tless", tmp_path / "file")


def test_a_source_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match="nowhere: not found; give an archive, a folder or an http"):
        fetch("tless", tmp_path / "to", "nowhere")
    with pytest.raises(ValueError, match="ycbv: unknown; tless or dtd"):
        fetch("ycbv", tmp_path / "to")  # type: ignore[arg-type]


OUTSIDE = [
    "../evil.ply",
    "/etc/evil",
    "models_cad/../../evil",
    "..\\evil",
    "C:\\evil",
    "C:evil",
    "\\\\host\\evil",
    "..",
]


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_a_path_that_points_outside_is_refused(name: str, kind: str, tmp_path: Path) -> None:
    files = {name: b"evil"} | tless_files()
    path = tmp_path / "in" / "archive"
    path.parent.mkdir()
    path.write_bytes(zipped(files) if kind == "zip" else tarred(files))
    with pytest.raises(ArchiveError, match="points outside"):
        fetch("tless", tmp_path / "a" / "to", str(path))
    assert tree(tmp_path) == ["in/archive"]


def _link(kind: bytes, name: str, to: str) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, to
    return info


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE])
def test_a_link_or_device_in_a_tar_is_refused(kind: bytes, tmp_path: Path) -> None:
    link = _link(kind, "models_cad/obj_000001.ply", "/etc/passwd")
    (tmp_path / "a.tar").write_bytes(tarred({}, "w", (link,)))
    with pytest.raises(ArchiveError, match=r"'models_cad/obj_000001\.ply' is a link or a device"):
        fetch("tless", tmp_path / "to", str(tmp_path / "a.tar"))
    assert tree(tmp_path) == ["a.tar"]


def test_a_link_in_a_zip_is_refused(tmp_path: Path) -> None:
    link = zipfile.ZipInfo("models_cad/obj_000001.ply")
    link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    (tmp_path / "a.zip").write_bytes(zipped({}, extra=(link,)))
    with pytest.raises(ArchiveError, match="is a link or a device"):
        fetch("tless", tmp_path / "to", str(tmp_path / "a.zip"))


def test_a_linked_folder_in_a_tar_leads_nowhere(tmp_path: Path) -> None:
    """Writing through a link that an earlier entry made is the classic escape; the entry is simply not made."""
    victim = tmp_path / "victim"
    victim.mkdir()
    links = (_link(tarfile.SYMTYPE, "models_cad", str(victim)), _link(tarfile.SYMTYPE, "tless", str(victim)))
    (tmp_path / "a.tar").write_bytes(tarred(tless_files(), "w", links))
    fetch("tless", tmp_path / "to", str(tmp_path / "a.tar"))
    assert list(victim.iterdir()) == []
    assert not (tmp_path / "to" / "models_cad").is_symlink()


def test_an_entry_that_comes_twice_is_refused(tmp_path: Path) -> None:
    files = {"models_cad/obj_000001.ply": b"a", "tless/models_cad/obj_000001.ply": b"b"}
    (tmp_path / "a.zip").write_bytes(zipped(files))
    with pytest.raises(ArchiveError, match="comes twice"):
        fetch("tless", tmp_path / "to", str(tmp_path / "a.zip"))


def small(data: DataSource, files: int = 10**6, size_bytes: int = 10**12) -> DataSource:
    return dataclasses.replace(data, limits=Limits(files, size_bytes))


@pytest.mark.parametrize("name", ["models_cad/obj_000001.ply", "unwanted.bin"])
@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
def test_a_bomb_is_refused_by_its_declared_size(name: str, kind: str, tmp_path: Path) -> None:
    bomb = {name: bytes(20 * MB)}
    path = tmp_path / "bomb"
    path.write_bytes(zipped(bomb) if kind == "zip" else tarred(bomb))
    assert path.stat().st_size < 100_000
    with pytest.raises(ArchiveError, match="unpacks to more than 10 MB"):
        obtain(small(TLESS, size_bytes=10 * MB), tmp_path / "to", str(path))
    assert tree(tmp_path) == ["bomb"]


def test_a_tar_header_that_declares_terabytes_is_refused(tmp_path: Path) -> None:
    info = tarfile.TarInfo("models_cad/obj_000001.ply")
    info.size = 10**13
    (tmp_path / "bomb").write_bytes(info.tobuf() + bytes(1024))
    with pytest.raises(ArchiveError, match="unpacks to more than 2000 MB"):
        fetch("tless", tmp_path / "to", str(tmp_path / "bomb"))


def test_a_zip_that_lies_about_a_size_writes_no_more_than_it_says(tmp_path: Path) -> None:
    honest = zipped({"models_cad/obj_000001.ply": bytes(5 * MB)})
    size, lie = (5 * MB).to_bytes(4, "little"), (100).to_bytes(4, "little")
    assert honest.count(size) == 2
    (tmp_path / "bomb.zip").write_bytes(honest.replace(size, lie))
    with pytest.raises(ArchiveError, match="damaged"):
        fetch("tless", tmp_path / "to", str(tmp_path / "bomb.zip"))
    assert tree(tmp_path) == ["bomb.zip"]


def test_too_many_entries_are_refused(tmp_path: Path) -> None:
    (tmp_path / "many.zip").write_bytes(zipped({f"{number}": b"" for number in range(100)}))
    with pytest.raises(ArchiveError, match="holds more than 50 files"):
        obtain(small(TLESS, files=50), tmp_path / "to", str(tmp_path / "many.zip"))


def test_a_disk_that_fills_while_unpacking_is_told_as_such(tless_zip: bytes, tmp_path: Path) -> None:
    (tmp_path / "models.zip").write_bytes(tless_zip)
    with files_of_at_most(500), pytest.raises(ValueError, match=r"to/models_cad: cannot be written \(File too large"):
        fetch("tless", tmp_path / "to", str(tmp_path / "models.zip"))
    assert tree(tmp_path) == ["models.zip"]


PARTS = st.sampled_from(["..", ".", "", "models_cad", "obj_000001.ply", "models_info.json", "a", "~", "/", "\\", "C:"])


@given(st.lists(PARTS, min_size=1, max_size=6), st.booleans())
def test_no_name_gets_out(tmp_path_factory: pytest.TempPathFactory, parts: list[str], rooted: bool) -> None:
    name = "/" * rooted + "/".join(parts)
    outer = tmp_path_factory.mktemp("outer")
    inner = outer / "one" / "two"
    inner.mkdir(parents=True)
    member = Member(name, 1, True, lambda: io.BytesIO(b"x"))
    try:
        written = unpack(iter([member]), TLESS.wanted, inner, TLESS.limits)
    except ArchiveError:
        written = 0
    files = [path for path in outer.rglob("*") if path.is_file()]
    assert len(files) == written
    assert all(path.parent == inner for path in files)
    shutil.rmtree(outer)


def test_a_report_reads_well() -> None:
    report = FetchReport("T-LESS CAD models", Path("data/models_cad"), 31, 30_900_000, True, "", Path("l"))
    assert str(report) == "T-LESS CAD models, fetched: 31 files, 30.9 MB in data/models_cad"
