"""Exports that are folders: which files there are is said once, and then written, or compared with what is there.

A file is either computed from the dataset or one of its own, which the export has as a link, or as a copy where the
folder is to be sent. ``export.json`` says what an export was asked for.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import TypeAdapter, ValidationError

from synthetless.dataset.labels import refuse_half_labelled
from synthetless.dataset.layout import refuse_target
from synthetless.errors import UserError
from synthetless.exports.annotated import licence_of
from synthetless.io.files import atomic_folder, read_bytes, read_json, write_json
from synthetless.io.parallel import each

EXPORT_FILE = "export.json"


@dataclass(frozen=True)
class Same:
    """Another file of the export, by its name, which is written before."""

    name: str


Content = bytes | Path | Same
"""Of a file: computed bytes, or the file, of the dataset or of the export, that it is."""
Entry = tuple[str, Content]
"""Its name, relative to the export's folder, and its content."""
Fault = Literal["missing", "differs"]


@dataclass(frozen=True)
class FolderExport:
    """What an export consists of; the fields are what it was asked for.

    Attributes:
        dataset: the dataset's folder.
        split: its folder of scenes.
        copy: whether files of the dataset are copied, not linked.
        kind: name of the format.
        owned: patterns of the files of which it has no others.
    """

    kind: ClassVar[str]
    owned: ClassVar[tuple[str, ...]]

    dataset: Path
    split: str
    copy: bool = False

    def parts(self) -> Sequence[Any]:
        """What is made one by one, shared out among processes."""
        raise NotImplementedError

    def entries(self, part: Any) -> Iterator[Entry]:
        """The files of a part."""
        raise NotImplementedError

    def common(self) -> Iterator[Entry]:
        """The files of the whole."""
        raise NotImplementedError

    def request(self) -> dict[str, Any]:
        """Content of export.json."""
        asked = {key: value for key, value in asdict(self).items() if key != "dataset"}
        return {"kind": self.kind, "options": asked, "licence": licence_of(self.dataset)}


def write_export(export: FolderExport, to: Path, workers: int | None = None) -> None:
    """Write an export into a new or empty folder, which appears when everything is written.

    Raises:
        UserError: the dataset is incomplete, or the folder belongs to it, holds something, or cannot be written.
    """
    refuse_target(export.dataset, to)
    refuse_half_labelled(export.dataset)
    parts = export.parts()
    with atomic_folder(to) as folder:
        for _ in each(partial(_write_part, export, folder), parts, workers, export.kind, "part"):
            pass
        _write(folder, export.common(), export.copy)
        write_json(folder / EXPORT_FILE, export.request())


def is_export(folder: Path) -> bool:
    """Whether ``write_export`` wrote this folder."""
    return (folder / EXPORT_FILE).is_file()


def read_export(folder: Path, dataset: Path, kinds: Iterable[type[FolderExport]]) -> FolderExport:
    """What a folder says that it was asked for, of the dataset as it is now.

    Raises:
        UserError: export.json is damaged, or of none of the ``kinds``.
    """
    path = folder / EXPORT_FILE
    content = read_json(path)
    of_kind = {kind.kind: kind for kind in kinds}.get(str(content.get("kind")))
    options = content.get("options")
    if of_kind is None or not isinstance(options, dict):
        raise UserError(f"{path}: is of no known kind of export; export anew")
    try:
        return TypeAdapter(of_kind).validate_python(options | {"dataset": dataset})
    except ValidationError as error:
        raise UserError(f"{path}: damaged ({error.errors()[0]['msg']}); export anew") from None


def compare(folder: Path, entries: Iterable[Entry]) -> Iterator[tuple[str, Fault | None]]:
    """Each file that there should be, with what is wrong with it."""
    for name, content in entries:
        path, source = folder / name, _source(folder, content)
        if not path.is_file():
            yield name, "missing"
        elif isinstance(source, Path) and path.resolve() == source.resolve():
            yield name, None
        else:
            expected = read_bytes(source) if isinstance(source, Path) else source
            yield name, None if read_bytes(path) == expected else "differs"


def owned_files(export: FolderExport, folder: Path) -> Iterator[str]:
    """The files of which the export has no others than its own."""
    for pattern in export.owned:
        for path in sorted(folder.glob(pattern)):
            yield path.relative_to(folder).as_posix()


def _write_part(export: FolderExport, folder: Path, part: Any) -> None:
    _write(folder, export.entries(part), export.copy)


def _write(folder: Path, entries: Iterable[Entry], copy: bool) -> None:
    """Write into a folder that nobody sees before it is whole."""
    for name, content in entries:
        path, source = folder / name, _source(folder, content)
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(source, bytes):
            path.write_bytes(source)
        elif copy:
            shutil.copyfile(source, path)
        else:
            _link(source, path)


def _source(folder: Path, content: Content) -> bytes | Path:
    return folder / content.name if isinstance(content, Same) else content


def _link(source: Path, path: Path) -> None:
    """A relative link, so that dataset and export may be moved together; of a file that is there."""
    try:
        path.symlink_to(os.path.relpath(source.resolve(strict=True), path.parent.resolve()))
    except FileNotFoundError:
        raise UserError(f"{source}: not found") from None
    except OSError as error:
        raise UserError(f"{path.parent}: no links can be made here ({error.strerror}); export with --copy") from None
