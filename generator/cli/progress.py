"""How a run's progress reaches people and schedulers: a bar in a terminal, lines elsewhere, or lines of JSON."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING

from synthetless.cli.terminal import printable

if TYPE_CHECKING:
    from synthetless.generation.progress import Progress

_LINE_EVERY_S = 60.0
_JSON_EVERY_S = 5.0


@contextmanager
def display(as_json: bool) -> Iterator[Callable[[Progress], None]]:
    """Show progress on stderr for the duration, as suits what stderr is."""
    if as_json:
        yield _Lines(_as_json, _JSON_EVERY_S)
    elif _is_terminal():
        with _bar() as tell:
            yield tell
    else:
        yield _Lines(str, _LINE_EVERY_S)


def _is_terminal() -> bool:
    """Whether stderr is a terminal of a known size; in one of no rows, as containers may have, tqdm draws nothing."""
    if not sys.stderr.isatty():
        return False
    try:
        return min(os.get_terminal_size(sys.stderr.fileno())) > 0
    except OSError:
        return True


class _Lines:
    """A line for each phase, and one from time to time while images are made."""

    def __init__(self, line: Callable[[Progress], str], every_s: float) -> None:
        self._line = line
        self._every_s = every_s
        self._phase = ""
        self._next_s = 0.0

    def __call__(self, progress: Progress) -> None:
        now = time.monotonic()
        if progress.phase != self._phase or now >= self._next_s:
            self._phase, self._next_s = progress.phase, now + self._every_s
            print(self._line(progress), file=sys.stderr, flush=True)


@contextmanager
def _bar() -> Iterator[Callable[[Progress], None]]:
    from tqdm import tqdm

    with tqdm(total=1.0, bar_format="{percentage:3.0f}%|{bar:20}| {desc}", dynamic_ncols=True, leave=False) as bar:
        bar.set_description_str("starting")

        def tell(progress: Progress) -> None:
            bar.n = progress.share
            bar.set_description_str(printable(str(progress)))

        yield tell


def _as_json(progress: Progress) -> str:
    return json.dumps(asdict(progress))
