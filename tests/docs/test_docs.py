"""The documentation is true: every command and snippet of README.md and docs/*.md is run, on small data.

Each page is one test case. Its commands and Python snippets run in their order, in a fresh folder that has what a
reader has there: configs/, the Makefile, .venv, and what another page made before. What is changed to keep it small,
what is taken for granted, and what is not run, stands in the tables below; the rest runs as it is printed.
"""

from __future__ import annotations

import doctest
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
import yaml

from docs.figures.tless import overlay
from tests.test_architecture import FLOORS

if find_spec("bpy") is None:
    pytest.skip("the documentation's commands need Blender, extra 'blender'", allow_module_level=True)
pytest.importorskip("matplotlib", reason="the documentation's commands need matplotlib, extra 'preview'")

ROOT = Path(__file__).resolve().parents[2]
PAGES = {str(path.relative_to(ROOT)): path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))}

SMALL_RECIPE: dict[str, Any] = {
    "images": 2,
    "camera": {"width": 96, "height": 72, "fx": 170.0, "fy": 170.0, "cx": 47.5, "cy": 35.5},
    "objects": {"count": [2, 4]},
    "render": {"samples": 1, "denoiser": "none", "bounces": 1},
}
"""What the recipes of configs/ are changed to; their other settings stay."""

SMALL_TRAINING: dict[str, Any] = {
    "network": {"channels": 16, "hidden": 32, "weights": "none"},
    "schedule": {"steps": 1, "images_per_step": 1},
}
"""What the trainings of configs/learning/ are changed to."""

CHANGED = (
    (r"--images \d+(?!.*--dry-run)", "--images 2", "two images show what 30,000 would"),
    (r"symmetries detect T-LESS/models_cad", "symmetries detect {part}", "30 parts take minutes"),
    (
        r"^synthetless compare ",
        "synthetless compare --steps 2 --seeds 1 --crops 20 ",
        "1500 steps of 15 runs take long",
    ),
    (r"^synthetless (train|predict|compare) ", r"{torch} \1 ", "torch is not installed everywhere"),
    (r"generate demo ", "generate configs/demo.yaml ", "the recipe that is small here"),
    (r"recipes --copy demo$", r"\g<0> && cp configs/demo.yaml demo.yaml", "likewise"),
    (r"^make ", "make -o setup ", "the environment is there already"),
    (r"fetch tless --to \S+$", r"\g<0> --from {tless}", "a test has no network"),
    (r"fetch dtd --to \S+$", r"\g<0> --from {dtd}", "a test has no network"),
)
"""What is changed in commands: a pattern, what stands in its place, and why."""

NOT_RUN = (
    (r"make setup( PYTHON=.*)?", "makes the environment that this test runs in"),
    (r"source \.venv/bin/activate", "a page's commands find the environment's programs already"),
    (r"python3\.11 -m venv .*|pip install 'PATH.*", "likewise; .ci/wheel does that"),
    (r"docker .*", "needs Docker; see test_docker.py"),
    (r"sudo (make system-libraries|apt-get .*)", "installs packages, as root"),
    (r"sbatch .*", "needs SLURM"),
    (r"ray (start|stop).*|.* --executor ray .*", "would stop every Ray on this machine; see test_cluster.py"),
    (r"ray (up|exec|attach|down|rsync-up|rsync-down) .*", "rents machines"),
    (r"synthetless --install-completion", "writes into the reader's home; see test_completion.py"),
)
"""Commands that are not run, and why. A new command that is not listed here is run, and has to work."""

GENERATE_TLESS = (
    "synthetless generate configs/synthetless.yaml --models T-LESS/models_cad --textures DTD/images --out tless"
)

LANGUAGES = {"", "sh", "bash", "console", "python", "pycon", "yaml", "json", "text"}
"""A block in another one would be overlooked."""

PROGRAMS = r"^(\$ )?(synthetless|make|python|pip|sudo|sbatch|ray|curl|wget) "


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    text: str
    line: int


@dataclass(frozen=True)
class Command:
    """A command of a page; and what it prints, if the page shows that."""

    line: str
    shown: str | None = None

    @property
    def is_refused(self) -> bool:
        return self.shown is not None and self.shown.startswith("synthetless: ")


def blocks(page: str) -> list[Block]:
    found = re.finditer(r"^```(\S*)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    return [Block(each[1], each[2], page.count("\n", 0, each.start()) + 1) for each in found]


def commands(block: Block) -> Iterator[Command]:
    """The commands of a block: every line of a sh block that is no comment, the lines after $ of a console block."""
    text = block.text.replace("\\\n", " ")
    if block.language == "console":
        for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
            line, _, shown = part.partition("\n")
            yield Command(line.strip(), shown)
    elif block.language in ("sh", "bash"):
        plain = (re.sub(r"(^|\s+)# .*", "", line).strip() for line in text.splitlines())
        yield from (Command(line) for line in plain if line)


def is_run(command: Command) -> bool:
    return not any(re.fullmatch(pattern, command.line) for pattern, _ in NOT_RUN)


class Reader:
    """Somebody who follows a page to the letter, in a folder of their own."""

    def __init__(self, folder: Path, sources: dict[str, Callable[[], Path]]) -> None:
        self.folder = folder
        self.sources = sources
        self.not_possible: list[str] = []
        self.names: dict[str, Any] = {"__name__": "__main__"}
        (folder / "configs").mkdir()
        for path in (ROOT / "configs").glob("*.yaml"):
            recipe = merged(yaml.safe_load(path.read_text(encoding="utf-8")), SMALL_RECIPE)
            (folder / "configs" / path.name).write_text(yaml.safe_dump(recipe), encoding="utf-8")
        (folder / "configs" / "learning").mkdir()
        for path in (ROOT / "configs" / "learning").glob("*.yaml"):
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
            small = merged(content, SMALL_RECIPE if "camera" in content else SMALL_TRAINING)
            (folder / "configs" / "learning" / path.name).write_text(yaml.safe_dump(small), encoding="utf-8")
        (folder / ".venv").symlink_to(sys.prefix)
        (folder / "Makefile").symlink_to(ROOT / "Makefile")

    def follow(self, block: Block) -> None:
        """Do what a block says; fails if that fails."""
        for command in filter(is_run, commands(block)):
            self.run(command)
        if block.language == "python":
            exec(compile(block.text, f"<the page, from line {block.line}>", "exec"), self.names)
        elif block.language == "pycon":
            examples = doctest.DocTestParser().get_doctest(block.text, self.names, "page", "page", block.line)
            assert doctest.DocTestRunner().run(examples, clear_globs=False).failed == 0
            self.names = examples.globs
        elif block.language == "yaml" and (name := re.match(r"# (\S+\.yaml)\n", block.text)):
            (self.folder / name[1]).write_text(block.text, encoding="utf-8")

    def run(self, command: Command) -> None:
        line = command.line
        for pattern, replacement, _ in CHANGED:
            line = re.sub(pattern, replacement, line)
        for name in re.findall(r"\{(\w+)\}", line):
            try:
                line = line.replace(f"{{{name}}}", str(self.sources[name]()))
            except pytest.skip.Exception as absent:
                self.not_possible.append(f"{command.line}: {absent}")
                return
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            ("bash", "-euo", "pipefail", "-c", line),
            cwd=self.folder,
            env={**os.environ, "PATH": path, "COLUMNS": "120"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        told = f"{line}\nexit code {done.returncode}\n{done.stdout}"
        assert done.returncode == (2 if command.is_refused else 0), told
        if command.shown is not None:
            assert re.search(as_pattern(command.shown), done.stdout), told


def merged(recipe: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    both = {key: merged(recipe.get(key, {}), value) for key, value in changes.items() if isinstance(value, dict)}
    return recipe | changes | both


def linked(place: Path, target: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)


def as_pattern(shown: str) -> str:
    """What a page shows of an output, as a pattern: "..." is anything, white space any white space."""
    words = (re.escape(word).replace(re.escape("..."), ".*") for word in shown.split())
    return r"\s+".join(words)


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """out/demo as `make demo` leaves it."""
    folder = tmp_path_factory.mktemp("demo")
    Reader(folder, {}).run(Command("make demo"))
    return folder / "out" / "demo"


@pytest.fixture(scope="session")
def dtd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that has as many textures in as many categories as the Describable Textures, but tiny ones."""
    folder = tmp_path_factory.mktemp("dtd")
    noise = np.random.default_rng(0).integers(0, 255, (16, 16, 3), dtype=np.uint8)
    photograph = cv2.imencode(".jpg", noise)[1].tobytes()
    for category in range(47):
        (folder / f"category_{category:02d}").mkdir()
        for number in range(120):
            (folder / f"category_{category:02d}" / f"{number:04d}.jpg").write_bytes(photograph)
    return folder


@pytest.fixture(scope="session")
def models(request: pytest.FixtureRequest, builtin_models: Path) -> Path:
    """The T-LESS models, or else the parts that come with the project, which are a BOP models folder as well."""
    try:
        return Path(request.getfixturevalue("tless_models"))
    except pytest.skip.Exception:
        return builtin_models


@pytest.fixture(scope="session")
def tless(tmp_path_factory: pytest.TempPathFactory, models: Path, dtd: Path) -> Path:
    """The dataset that the README's and other pages' command leaves in tless; to go on with it takes less time."""
    folder = tmp_path_factory.mktemp("tless")
    reader = Reader(folder, {})
    linked(folder / "T-LESS" / "models_cad", models)
    linked(folder / "DTD" / "images", dtd)
    reader.run(Command(f"{GENERATE_TLESS} --images 30000"))
    return folder / "tless"


@pytest.fixture(scope="session")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that has one CAD file."""
    folder = tmp_path_factory.mktemp("part")
    trimesh.creation.box((60, 40, 20)).export(folder / "part.stl")
    return folder


@pytest.fixture(scope="session")
def program_with_torch() -> Path:
    """The command, where it can train."""
    pytest.importorskip("torch", reason="torch is not installed; extra 'learn' has it")
    return Path(sys.executable).parent / "synthetless"


@pytest.fixture
def made_before(request: pytest.FixtureRequest) -> dict[str, Callable[[Path], object]]:
    """What pages take for granted where they name it, and how it comes into a reader's folder."""

    def copy_of(fixture: str) -> Callable[[Path], object]:
        return lambda place: shutil.copytree(request.getfixturevalue(fixture), place)

    def link_to(fixture: str) -> Callable[[Path], object]:
        return lambda place: linked(place, request.getfixturevalue(fixture))

    def bop_dataset(place: Path) -> None:
        scene = place / "train_primesense" / "000001"
        scene.mkdir(parents=True)
        pose = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [10.0, 20.0, 700.0], "obj_id": 5}
        camera = {"cam_K": [1075.0, 0.0, 199.5, 0.0, 1075.0, 199.5, 0.0, 0.0, 1.0], "depth_scale": 0.1}
        (scene / "scene_gt.json").write_text(json.dumps({"0": [pose]}), encoding="utf-8")
        (scene / "scene_camera.json").write_text(json.dumps({"0": camera}), encoding="utf-8")

    def table(place: Path) -> None:
        place.write_text("object 5: {group: C2}\n", encoding="utf-8")

    def almost(place: Path) -> None:
        place.write_text("object 5: {group: C2, quasi: C4}\n", encoding="utf-8")

    def results(place: Path) -> None:
        place.write_text("scene_id,im_id,obj_id,score,R,t,time\n", encoding="utf-8")

    return {
        "T-LESS/models_cad": link_to("models"),
        "DTD/images": link_to("dtd"),
        "out/demo": copy_of("demo"),
        "out/demo_gpu": copy_of("demo"),  # docs/scaling.md; the recipe is the same
        "out/parts": copy_of("demo"),  # docs/scaling.md, likewise
        "tless": copy_of("tless"),
        "BOP/tless": bop_dataset,
        "DIR": copy_of("demo"),  # docs/symmetry.md
        "my.yaml": table,  # docs/symmetry.md
        "almost.yaml": almost,  # docs/symmetry.md
        "results.csv": results,  # docs/learning.md, without torch
    }


@pytest.mark.blender
@pytest.mark.parametrize("name", PAGES)
def test_a_page_can_be_followed(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
    made_before: dict[str, Callable[[Path], object]],
) -> None:
    page = blocks(PAGES[name].read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    sources = {"tless": "tless_models", "dtd": "dtd", "part": "part", "torch": "program_with_torch"}
    reader = Reader(tmp_path, {key: partial(request.getfixturevalue, value) for key, value in sources.items()})
    said = "\n".join(block.text for block in page)
    has_tless = request.getfixturevalue("models") != request.getfixturevalue("builtin_models")
    for place, make in made_before.items():
        is_fetched = f"--to {place.partition('/')[0]}\n" in said and (place != "T-LESS/models_cad" or has_tless)
        if re.search(rf"(?<![\w/]){re.escape(place)}(?!\w)", said) and not is_fetched:
            (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
            make(tmp_path / place)
    for block in page:
        reader.follow(block)
    if reader.not_possible:
        pytest.skip("all but: " + "; ".join(reader.not_possible))


@pytest.mark.parametrize(
    "text",
    [
        "```sh\nfalse\n```\n",
        "```sh\nmissing-program --help\n```\n",
        "```sh\nfalse | cat\n```\n",
        "```sh\ntrue \\\n  --option | grep nothing\n```\n",
        "```sh\ntrue  # a comment\necho $UNSET\n```\n",
        "```console\n$ echo one\ntwo\n```\n",
        "```console\n$ echo synthetless: refused\nsynthetless: refused\n```\n",
        "```python\nassert 1 + 1 == 3\n```\n",
        "```pycon\n>>> 1 + 1\n3\n```\n",
    ],
)
def test_a_false_page_is_found(text: str, tmp_path: Path) -> None:
    (block,) = blocks(text)
    with pytest.raises(AssertionError):
        Reader(tmp_path, {}).follow(block)


def test_a_true_page_is_followed(tmp_path: Path) -> None:
    page = """
```sh
echo "one  two" \\
    > file.txt        # a comment
```
```console
$ cat file.txt
one two
$ (echo synthetless: refused; exit 2)
synthetless: ...fused
```
"""
    reader = Reader(tmp_path, {})
    for block in blocks(page):
        reader.follow(block)
    assert (tmp_path / "file.txt").read_text() == "one  two\n"


@pytest.mark.blender
def test_the_script_of_the_readme_s_picture_draws_one(demo: Path) -> None:
    halves = []
    for im_id in (0, 1):
        drawn = overlay(demo, im_id)
        middle = drawn.shape[1] // 2
        halves.append((drawn[:, : middle - 4], drawn[:, middle + 4 :]))
    assert all(left.shape == right.shape and min(left.shape[:2]) > 50 for left, right in halves)
    assert any((left != right).any() for left, right in halves), "true poses, canonical poses"


def test_pictures_are_small_and_shown() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES.values())
    for picture in (ROOT / "docs" / "images").iterdir():
        assert picture.stat().st_size < 300_000, picture.name
        assert f"images/{picture.name})" in text, picture.name


@pytest.mark.parametrize("name", PAGES)
def test_a_page_has_only_blocks_that_are_understood(name: str) -> None:
    text = PAGES[name].read_text(encoding="utf-8")
    found = blocks(text)
    assert len(found) * 2 == len(re.findall(r"^\s*(```|~~~)", text, re.MULTILINE)), "an indented or unfinished block"
    assert {block.language for block in found} <= LANGUAGES
    for block in found:
        if block.language in ("", "text"):
            assert not re.search(PROGRAMS, block.text, re.MULTILINE), "commands stand in ```sh"
        if block.language == "yaml":
            yaml.safe_load(block.text)
    for row in re.findall(r"^\|.*$", text, re.MULTILINE):
        assert row.endswith("|"), f"a table row without an end: {row}"


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_to_files_and_sections(name: str) -> None:
    page = PAGES[name]
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", page.read_text(encoding="utf-8")):
        path, _, section = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        if section:
            titles = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
            assert section in anchors, target


def test_every_page_is_in_the_index() -> None:
    index = PAGES["docs/README.md"].read_text(encoding="utf-8")
    for page in PAGES.values():
        if page.parent.name == "docs" and page.name != "README.md":
            assert f"({page.name})" in index, page.name


def test_what_is_not_run_is_said_somewhere() -> None:
    """An entry that no page needs any more hides nothing, but misleads."""
    found = [block for page in PAGES.values() for block in blocks(page.read_text(encoding="utf-8"))]
    lines = [command.line for block in found for command in commands(block)]
    for pattern, _ in NOT_RUN:
        assert any(re.fullmatch(pattern, line) for line in lines), pattern


def test_the_files_that_the_architecture_names_exist() -> None:
    text = PAGES["docs/architecture.md"].read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:generator|scenes|configs|tests|src)/[\w/.]+)`", text))
    assert len(named) > 25
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_what_a_step_of_a_walk_calls_is_in_its_file() -> None:
    """In docs/architecture.md, a row "| `file.py` | `name` does something | ... |" names what that file defines."""
    text = PAGES["docs/architecture.md"].read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w/]+\.py)` \| (.+?) \|", text, re.MULTILINE)
    assert len(rows) > 15
    for file, step in rows:
        source = (ROOT / file).read_text(encoding="utf-8")
        for name in re.findall(r"`(?:\w+\.)*(\w+)(?:\(\))?`", step):
            assert re.search(rf"\b{name}\b", source), f"{file}: {name}"


def test_the_architecture_s_floors_are_those_that_imports_are_held_to() -> None:
    text = PAGES["docs/architecture.md"].read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (`.+?`) \|", text, re.MULTILINE)
    told = {name: int(floor) for floor, names in rows for name in re.findall(r"`(\w+)/?`", names)}
    assert told == {room: number for number, rooms in enumerate(FLOORS, start=1) for room in rooms}
