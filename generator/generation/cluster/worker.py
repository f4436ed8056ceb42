"""A worker of the cluster: an actor with a renderer of its own, somewhere on a node."""

from __future__ import annotations

import os
import platform
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import psutil

from synthetless.dataset.layout import LOGS_FOLDER
from synthetless.dataset.store import Dataset, DatasetError, FinishedImage, versions
from synthetless.errors import UserError
from synthetless.generation.devices import take_assigned
from synthetless.generation.drop import DropFailed, DropRenderer
from synthetless.generation.executors import FAULT_VARIABLE, GROWTH_LIMIT_BYTES, Job, Workplace, inject_fault, stumbled
from synthetless.generation.sources import Sources
from synthetless.io.files import atomic_write
from synthetless.scenes.blender import BlenderError


@dataclass(frozen=True)
class Supplies:
    """What is sent to every worker, once for each node.

    Attributes:
        sources: the models, and the names of the photographs.
        digest: of the scenery where the sources were loaded.
        versions: what must be installed on the node, too.
    """

    sources: Sources
    digest: str
    versions: Mapping[str, str]

    @classmethod
    def of(cls, sources: Sources) -> Supplies:
        """Those for a dataset that is made from these sources."""
        return cls(sources, sources.scenery_digest, versions())


@dataclass(frozen=True)
class Desk:
    """Where a worker has moved in.

    Attributes:
        node_id: Ray's name of the node.
        node: the node's own name.
        process: the worker's number there.
        lacks_photos: whether it could not begin, since the photographs are not there.
    """

    node_id: str
    node: str
    process: int
    lacks_photos: bool = False


@dataclass(frozen=True)
class Delivery:
    """What a worker hands back of a job.

    Attributes:
        made: how many images.
        images: those that are still to be committed.
        failure: why some are missing, "" if none are.
        swollen: whether its memory has grown so much that it should be replaced.
    """

    made: int
    images: tuple[FinishedImage, ...]
    failure: str
    swollen: bool


class Worker:
    """The actor; one drop at a time."""

    def __init__(self, place: Workplace, token: Path, faults: str) -> None:
        """Sit down.

        Args:
            place: what to know.
            token: a file in the dataset's folder; who may write it shares the folder.
            faults: for tests, see ``workers.FAULT_VARIABLE``.
        """
        os.environ[FAULT_VARIABLE] = faults
        self._place = place
        shares_folder = os.access(token, os.W_OK)
        self._dataset = Dataset(place.root, place.recipe) if shares_folder else None
        name = f"worker-{platform.node()}-{os.getpid()}.log"
        # Ray keeps what its workers print, in a file for each of them.
        self._log = place.root / LOGS_FOLDER / name if shares_folder else Path("/dev/stdout")

    def move_in(self, supplies: Supplies, photos: Mapping[str, bytes] | None) -> Desk:
        """Set up the renderer.

        Args:
            supplies: what it is made from.
            photos: content of the photographs by name; None as long as no node has been found to lack them.

        Raises:
            UserError: something else is installed here, or there is no such device.
            BlenderError: Blender cannot be used.
        """
        import ray

        desk = Desk(ray.get_runtime_context().get_node_id(), platform.node(), os.getpid())
        try:
            check_versions(supplies.versions)
            sources = _with_photos(supplies, photos)
            if sources is None:
                return replace(desk, lacks_photos=True)
            device = take_assigned(self._place.devices)
            self._studio = DropRenderer(self._place.recipe, sources, self._place.threads, device, self._log)
        except BlenderError as error:
            raise BlenderError(f"node {desk.node}: {error}") from None
        except ValueError as error:
            raise UserError(f"node {desk.node}: {error}") from None
        self._memory_limit = psutil.Process().memory_info().rss + GROWTH_LIMIT_BYTES
        return desk

    def make(self, job: Job) -> Delivery:
        """Make the images of one drop, and commit them if the dataset's folder is shared.

        Raises:
            DatasetError: a file cannot be written.
        """
        images: list[FinishedImage] = []
        made, failure = 0, ""
        try:
            inject_fault(job.drop)
            for image in self._studio.make(job.drop, job.images):
                if self._dataset is None:
                    images.append(image)
                else:
                    self._dataset.commit(image)
                made += 1
        except (DatasetError, BlenderError):
            raise
        except DropFailed as error:
            failure = str(error)
        except Exception as error:  # whatever one drop stumbles over, the others can be made
            failure = stumbled(error)
        return Delivery(made, tuple(images), failure, psutil.Process().memory_info().rss > self._memory_limit)

    def answer(self) -> None:
        """Do nothing, when everything that was asked before is done: whoever hears of it knows that this one lives."""


def check_versions(wanted: Mapping[str, str]) -> None:
    """Refuse what would give other pixels, here and there in one dataset.

    Raises:
        UserError: something else than wanted is installed.
    """
    for name, here in versions().items():
        if here != wanted[name]:
            raise UserError(f"has {name} {here}, but {wanted[name]} is needed; install the same on every node")


def _with_photos(supplies: Supplies, photos: Mapping[str, bytes] | None) -> Sources | None:
    """The sources with photographs that are on this node: its own, or those sent; None if there are neither."""
    sources = supplies.sources
    if sources.photos_folder is None:
        return sources
    with suppress(OSError):
        if sources.scenery_digest == supplies.digest:
            return sources
    if photos is None:
        return None
    # One for all workers of the node; what is in it may stay, since it is called by its content.
    folder = Path(tempfile.gettempdir()) / f"synthetless-{os.getuid()}-{supplies.digest[:16]}"
    for name, content in photos.items():
        if not (folder / name).exists():
            atomic_write(folder / name, content)
    return replace(sources, photos_folder=folder)
