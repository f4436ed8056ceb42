"""How a dataset is begun, continued and retried: nothing is written before the lock is held."""

from __future__ import annotations

import json
import multiprocessing
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from trees import contents

from synthetless.config import Recipe, load_recipe
from synthetless.dataset.layout import DATASET_FILE, Part
from synthetless.dataset.reader import read_recipe
from synthetless.generation import estimate as estimation
from synthetless.generation import executors
from synthetless.generation import generate as generation
from synthetless.generation.executors import DropResult, DropTask
from synthetless.generation.generate import Execution, generate, retry
from synthetless.generation.rerender import render_again
from synthetless.io.files import LockedError, in_turn, locked
from synthetless.scenes.blender import BlenderError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    return load_recipe(ROOT / "configs" / "demo.yaml", ["images=4"])


@pytest.fixture
def begun(recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset without images; nothing is rendered in these tests."""
    monkeypatch.setattr(generation, "_make", lambda *_: [])
    monkeypatch.setattr(generation, "_draw_sheet", lambda _: None)
    generate(recipe, tmp_path / "d", Execution(workers=1))
    return tmp_path / "d"


@pytest.mark.parametrize("part", [None, Part(1, 2)], ids=["whole", "part"])
def test_nothing_is_begun_where_another_is_at_work(part: Part | None, recipe: Recipe, tmp_path: Path) -> None:
    with locked(tmp_path):
        before = contents(tmp_path)
        with pytest.raises(LockedError, match="another synthetless is writing here"):
            generate(recipe, tmp_path, Execution(workers=1, part=part))
        assert contents(tmp_path) == before


def test_nothing_is_continued_or_retried_where_another_is_at_work(begun: Path, recipe: Recipe) -> None:
    (begun / "camera.json").unlink()
    calls: list[Callable[[], object]] = [
        lambda: generate(recipe, begun, Execution(workers=1)),
        lambda: retry(begun, 0),
    ]
    with locked(begun):
        before = contents(begun)
        for call in calls:
            with pytest.raises(LockedError):
                call()
        assert contents(begun) == before


def test_parts_that_begin_at_once_are_of_one_recipe(
    recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While one of them begins the dataset, the other waits, and then finds what it was begun with."""
    monkeypatch.setattr(generation, "_make", lambda *_: [])
    ended: list[object] = []

    def make(seed: int) -> None:
        mine = recipe.model_copy(update={"seed": seed})
        try:
            ended.append(generate(mine, tmp_path, Execution(workers=1, part=Part(seed, 2))))
        except ValueError as error:
            ended.append(error)

    threads = [threading.Thread(target=make, args=(seed,)) for seed in (1, 2)]
    with in_turn(tmp_path):
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob(".synthetless.*-of-2.lock"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(0.5)
        assert not (tmp_path / DATASET_FILE).exists()
        assert not ended
    for thread in threads:
        thread.join(60)
    refused = [str(result) for result in ended if isinstance(result, ValueError)]
    assert len(ended) == 2
    assert len(refused) == 1
    assert "was begun with seed" in refused[0]


def test_a_foreign_folder_is_left_as_it_is(recipe: Recipe, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for part in (None, Part(1, 2)):
        with pytest.raises(ValueError, match=r"holds notes\.txt, but no dataset\.json"):
            generate(recipe, tmp_path, Execution(workers=1, part=part))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_an_estimate_writes_nothing(begun: Path, recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even what is missing: another run may be at work there."""
    (begun / "camera.json").unlink()
    monkeypatch.setattr(estimation, "_measure", lambda *_: (1.0, 2.0, 1000))
    before = contents(begun)
    with locked(begun):
        assert estimation.estimate(recipe, begun, Execution(workers=1)).images == 4
    assert contents(begun) == before
    with pytest.raises(ValueError, match="was begun with seed"):
        estimation.estimate(recipe.model_copy(update={"seed": 5}), begun, Execution(workers=1))


def test_a_note_that_cannot_be_removed_is_named(begun: Path, recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder in its place stands for whatever keeps it from being removed."""
    note = begun / ".failures" / "00000001.json"
    note.mkdir(parents=True)

    def run(*_: object) -> Generator[DropResult, None, None]:
        yield DropResult(DropTask(1, ()), made=1)

    monkeypatch.undo()
    monkeypatch.setattr(executors, "run", run)
    with pytest.raises(ValueError, match=rf"^{note}: cannot be removed \("):
        generate(recipe, begun, Execution(workers=1))


def test_a_drop_that_is_not_there_is_not_retried(begun: Path, tmp_path: Path) -> None:
    before = contents(begun)
    with pytest.raises(ValueError, match="has no drop 7; its 4 images show the drops from 0 on"):
        retry(begun, 7)
    assert contents(begun) == before
    with pytest.raises(ValueError, match=r"nothing/dataset\.json: not found"):
        retry(tmp_path / "nothing", 0)
    assert not (tmp_path / "nothing").exists()


def test_workers_that_hang_while_starting_end_the_run(
    recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit that no start can keep stands for the hanging."""
    monkeypatch.setattr(executors, "_START_LIMIT_S", 0.0)
    config = executors.WorkerConfig(recipe, tmp_path, threads=1, drop_limit_s=60.0)
    told = r"^workers die while starting, the last one with no answer within 0 s; "
    with pytest.raises(BlenderError, match=told):
        list(executors.run([DropTask(0, ())], config, 2))
    assert not multiprocessing.active_children()


def test_a_dataset_is_continued_at_the_quality_it_was_made_with_or_not_at_all(recipe: Recipe, begun: Path) -> None:
    """What a quality stands for has changed; it is recorded, and so neither forgotten nor mixed up."""
    file = begun / DATASET_FILE
    header = json.loads(file.read_text())
    assert header["recipe"]["render"]["denoiser"] == recipe.render.denoiser
    header["recipe"]["render"] |= {"samples": 12, "detail_samples": 0, "denoiser": "fast"}  # as `standard` was
    file.write_text(json.dumps(header))
    before = contents(begun)
    with pytest.raises(
        ValueError, match=r"begun with render\.denoiser = fast, now it is guided, .*render\.samples = 12"
    ):
        generate(recipe, begun, Execution(workers=1))
    assert contents(begun) == before
    as_before = recipe.render.model_copy(update={"samples": 12, "detail_samples": 0, "denoiser": "fast"})
    generate(recipe.model_copy(update={"render": as_before}), begun, Execution(workers=1))
    assert read_recipe(begun).render == as_before


def test_what_an_earlier_guided_denoiser_made_is_not_continued(recipe: Recipe, begun: Path) -> None:
    file = begun / DATASET_FILE
    header = json.loads(file.read_text())
    header["recipe"]["render"] |= {"samples": 7, "denoiser": "guided"}
    del header["recipe"]["render"]["detail_share"]
    file.write_text(json.dumps(header))
    before = contents(begun)
    as_before = recipe.render.model_copy(update={"samples": 7, "detail_samples": 0})
    with pytest.raises(
        ValueError, match=r"begun with an earlier guided denoiser, which is gone: .*; use another output folder"
    ):
        generate(recipe.model_copy(update={"render": as_before}), begun, Execution(workers=1))
    with pytest.raises(ValueError, match=r"earlier guided denoiser, which is gone"):
        render_again(begun, 1, 0)
    assert contents(begun) == before
