"""Where a run stands: what is done now, how much is done, and how long the rest takes."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

STARTING, COLLIDERS, DROPPING, RENDERING = "starting Blender", "preparing colliders", "dropping objects", "rendering"
STAGES = (STARTING, COLLIDERS, DROPPING, RENDERING)
"""What a worker does, in the order in which it does it."""
READING, MAKING, FINISHING, DONE = "reading models", "making images", "writing the dataset's files", "done"
_WINDOW = 100
"""The rate is that of so many drops."""


@dataclass(frozen=True)
class Progress:
    """Where a run stands.

    Attributes:
        phase: what the run is at: "reading models", "checking textures", one of STAGES until the first drop is made,
            then "making images", "writing the dataset's files", "done".
        doing: the same with what each worker does, or how many of how many.
        images: made by this run so far.
        wanted: images that this run is to make; 0 as long as that is not known.
        share: of the run's work that is done, 0 to 1, with what is done of the drops that are under way.
        failed_drops: how many drops failed.
        elapsed_s: since the run began.
        images_per_hour: over the last hundred drops; None until one is made.
        left_s: how long the rest takes at this rate; None until one is made.
    """

    phase: str
    doing: str
    images: int = 0
    wanted: int = 0
    share: float = 0.0
    failed_drops: int = 0
    elapsed_s: float = 0.0
    images_per_hour: float | None = None
    left_s: float | None = None

    def __str__(self) -> str:
        """Images, rate and time left as soon as they are known; then what is done now."""
        known = [f"{self.images} of {self.wanted} images"] if self.wanted else []
        if self.images_per_hour is not None and self.left_s is not None:
            known += [f"{self.images_per_hour:.0f} an hour", f"{_clock(self.left_s)} left"]
        if self.failed_drops:
            known.append(f"{self.failed_drops} failed drop{'s' if self.failed_drops > 1 else ''}")
        return ": ".join(filter(None, (", ".join(known), self.doing)))


def _clock(seconds: float) -> str:
    """A time as h:mm:ss, or m:ss if it is short; rounded up, so that what is left is never nothing."""
    minutes, rest = divmod(math.ceil(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


Tell = Callable[[Progress], None]
"""Is called with every change, and about once a second."""


def silent(_: Progress) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Stage:
    """What a worker does.

    Attributes:
        name: one of STAGES.
        detail: which of how many, such as "3 of 7"; "" if there is nothing to tell.
        share: of its drop that is done, 0 to 1.
    """

    name: str
    detail: str = ""
    share: float = 0.0


Report = Callable[[Stage], None]


def unreported(_: Stage) -> None:
    """Report to nobody."""


@dataclass(frozen=True)
class Work:
    """What a worker does, and how many images its drop is to give."""

    stage: Stage
    images: int = 0


class Tracker:
    """Follows a run and tells where it stands."""

    def __init__(self, tell: Tell, clock: Callable[[], float] = time.monotonic) -> None:
        self._tell = tell
        self._clock = clock
        self._began = clock()
        self._wanted = self._images = self._ended = self._failed = 0
        self._work: Sequence[Work] = ()
        self._window: deque[tuple[float, float]] = deque(maxlen=_WINDOW + 1)

    def phase(self, phase: str, detail: str = "") -> None:
        """Tell what is done before or after the workers."""
        self._tell(self._progress(phase, f"{phase} {detail}".rstrip()))

    def want(self, images: int) -> None:
        """Note how many images are to be made."""
        self._wanted = images

    def watch(self, work: Sequence[Work]) -> None:
        """Tell what the workers do now."""
        self._work = work
        if not self._window and any(each.images for each in work):
            self._window.append((self._clock(), 0.0))
        furthest = max((STAGES.index(each.stage.name) for each in work), default=0)
        self._tell(self._progress(MAKING if self._ended else STAGES[furthest], _in_words(work)))

    def ended(self, wanted: int, made: int, failed: bool) -> None:
        """Note what became of a drop, of which so many images were wanted."""
        self._ended += wanted
        self._images += made
        self._failed += failed
        self._window.append((self._clock(), float(self._ended)))

    def _progress(self, phase: str, doing: str) -> Progress:
        now = self._clock()
        done = self._ended + sum(each.stage.share * each.images for each in self._work)
        rate = None
        if self._ended:
            since, before = self._window[0]
            rate = (done - before) / (now - since) if now > since and done > before else None
        return Progress(
            phase=phase,
            doing=doing,
            images=self._images,
            wanted=self._wanted,
            share=1.0 if phase == DONE else min(done / self._wanted, 1.0) if self._wanted else 0.0,
            failed_drops=self._failed,
            elapsed_s=now - self._began,
            images_per_hour=None if rate is None else 3600 * rate,
            left_s=None if rate is None else max(self._wanted - done, 0.0) / rate,
        )


def _in_words(work: Sequence[Work]) -> str:
    """What several workers do, one phrase: for one of them with its detail, for many how many do what."""
    if not work:
        return MAKING
    if len(work) == 1:
        return " ".join(filter(None, (work[0].stage.name, work[0].stage.detail)))
    counts = Counter(each.stage.name for each in work)
    return ", ".join(f"{name} ({counts[name]})" for name in reversed(STAGES) if counts[name])
