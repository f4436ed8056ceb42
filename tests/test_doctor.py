"""Doctor: it finds what this machine has, names what another lacks, and outlives a Blender that crashes."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from synthetless import doctor, extras
from synthetless.doctor import Check, Status, examine, is_fit, to_json, to_text
from synthetless.generation.devices import Answer, ask
from synthetless.io.files import nearest_existing
from synthetless.scenes.settings import RenderSettings

STATUSES: tuple[Status, ...] = ("ok", "warn", "fail")


@pytest.mark.blender
def test_a_machine_that_renders_is_fit(tmp_path: Path) -> None:
    checks = {check.name: check for check in examine(tmp_path / "not" / "yet")}
    assert list(checks) == [
        *("Python", "Blender", "libraries", "devices", "cores", "memory", "disk", "writing", "render")
    ]
    for name in ("Python", "Blender", "libraries", "devices", "writing", "render"):
        assert checks[name].status == "ok", checks[name]
    assert checks["devices"].value.startswith(("CPU ", "CUDA ", "HIP ", "METAL ", "ONEAPI ", "OPTIX "))
    assert re.fullmatch(
        rf"\d+\.\d s for an image of 400x400, {RenderSettings().samples} samples", checks["render"].value
    )
    assert str(tmp_path) in checks["disk"].value
    assert not (tmp_path / "not").exists()


def _python(code: str) -> tuple[str, ...]:
    return (sys.executable, "-c", code)


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        ("import os; os.abort()", "crashed (SIGABRT)"),
        ("import ctypes; ctypes.string_at(0)", "crashed (SIGSEGV)"),
        ("import sys; print('nothing'); sys.exit('one\\nno bpy here')", "no bpy here"),
        ("raise SystemExit(3)", "ended with exit code 3"),
        ("print('hello')", "gave no answer"),
        ("print('[1]')", "gave no answer"),
        ("", "gave no answer"),
    ],
)
def test_what_happens_to_the_other_process_is_told(code: str, problem: str) -> None:
    assert ask(_python(code)) == Answer(None, problem)


def test_an_answer_is_the_last_line() -> None:
    assert ask(_python("print('Blender 4.5'); print('{\"a\": 1}')")) == Answer({"a": 1})


def test_a_process_that_hangs_is_given_up() -> None:
    assert ask(_python("import time; time.sleep(60)"), timeout_s=0.3) == Answer(None, "no answer within 0.3 s")


def test_a_missing_blender_is_named() -> None:
    answer = ask(
        _python("import sys; sys.modules['bpy'] = None; from synthetless.scenes.probe import main; main('devices')")
    )
    assert answer.problem.startswith("Blender is not installed")
    for check in (doctor.check_devices(answer), doctor.check_render(answer)):
        assert (check.status, check.value) == ("fail", answer.problem)
        assert "python -m synthetless.scenes.probe" in check.remedy


@pytest.fixture
def needy_library(tmp_path: Path) -> Path:
    """A real shared library that is linked with one that nobody has: its libX11 renamed by one letter."""
    for name in ("libXfixes.so.3", "libXrender.so.1", "libXext.so.6"):
        for folder in (Path("/lib"), Path("/usr/lib")):
            for found in folder.glob(f"*/{name}"):
                content = found.read_bytes().replace(b"libX11.so.6\0", b"libX1Q.so.6\0")
                if b"libX1Q" in content:
                    (tmp_path / "bpy.so").write_bytes(content)
                    return tmp_path / "bpy.so"
    pytest.skip("no X11 library to start from")


def test_a_missing_library_is_found(needy_library: Path) -> None:
    assert doctor.missing_libraries(needy_library) == ("libX1Q.so.6",)


def test_without_blender_the_libraries_it_needs_are_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "text.so").write_text("hello")
    monkeypatch.setitem(doctor.PACKAGES, "libnobody.so.7", "libnobody7")
    assert doctor.unresolved(tmp_path / "text.so") is None
    assert "libnobody.so.7" in doctor.missing_libraries(tmp_path / "text.so")
    assert "libnobody.so.7" in doctor.missing_libraries(None)


def test_a_blender_that_lacks_a_library_says_which(needy_library: Path) -> None:
    first = f"import sys; sys.path.insert(0, {str(needy_library.parent)!r})"
    code = f"{first}; from synthetless.scenes.probe import main; main('render')"
    assert "libX1Q.so.6" in ask(_python(code)).problem


@pytest.mark.blender
def test_blender_lacks_nothing_here() -> None:
    library = doctor.blender_library()
    assert library is not None
    assert library.name == "__init__.so"
    assert library.parent.name == "bpy"
    assert doctor.unresolved(library) == ()


def test_unloadable_libraries_are_told_from_others() -> None:
    assert doctor.unloadable(["libc.so.6", "libnobody.so.7"]) == ("libnobody.so.7",)


def test_missing_libraries_come_with_their_packages() -> None:
    check = doctor.check_libraries(("libSM.so.6", "libGL.so.1", "libodd.so.2"), ("libEGL.so.1",))
    assert check.status == "fail"
    assert check.value == "missing libSM.so.6, libGL.so.1, libodd.so.2"
    assert check.remedy == (
        "as root: apt-get install libsm6 libgl1 libegl1; apt-file search libodd.so.2 tells the package"
    )
    assert doctor.check_libraries((), ("libEGL.so.1",)).status == "warn"
    assert doctor.check_libraries((), ()).status == "ok"


@pytest.mark.skipif(not Path("/usr/bin/dpkg").exists(), reason="no Debian package manager here")
def test_the_packages_are_the_ones_that_bring_the_libraries() -> None:
    checked = 0
    for library, package in doctor.PACKAGES.items():
        listed = subprocess.run(["dpkg", "-L", package], capture_output=True, text=True, check=False)
        if listed.returncode == 0:
            assert f"/{library}\n" in listed.stdout, f"{package} does not bring {library}"
            checked += 1
    assert checked


def test_all_libraries_of_make_system_libraries_are_known() -> None:
    makefile = (Path(__file__).parents[1] / "Makefile").read_text()
    installed = re.search(r"apt-get install -y --no-install-recommends (.*)", makefile)
    assert installed
    assert set(installed[1].split()) <= set(doctor.PACKAGES.values())


@pytest.mark.parametrize(
    ("version", "status"), [((3, 11, 9), "ok"), ((3, 12, 0), "fail"), ((3, 10, 4), "fail"), ((3, 1, 1), "fail")]
)
def test_python(version: tuple[int, ...], status: Status) -> None:
    assert doctor.check_python(version).status == status


@pytest.mark.parametrize(
    ("version", "status", "remedy"),
    [
        ("4.5.15", "ok", ""),
        ("5.0.1", "warn", "pip install 'bpy==4.5.*'"),
        ("4.50.0", "warn", "pip install 'bpy==4.5.*'"),
        (None, "fail", extras.remedy("blender")),
    ],
)
def test_blender_version(version: str | None, status: Status, remedy: str) -> None:
    check = doctor.check_blender(version)
    assert (check.status, check.remedy) == (status, remedy)


def test_devices_are_listed() -> None:
    devices = [{"type": "CPU", "name": "EPYC"}, {"type": "OPTIX", "name": "H100"}]
    assert doctor.check_devices(Answer({"devices": devices})) == Check("devices", "ok", "CPU EPYC, OPTIX H100")
    assert doctor.check_devices(Answer({"devices": []})).status == "fail"


def test_a_black_image_is_a_failure() -> None:
    found = {"seconds": 1.23, "width": 400, "height": 300, "samples": 16, "mean": 0.2}
    assert doctor.check_render(Answer(found)) == Check("render", "ok", "1.2 s for an image of 400x300, 16 samples")
    assert doctor.check_render(Answer(found | {"mean": 0.0})).status == "fail"


def test_a_quota_below_the_number_of_cores_is_told() -> None:
    assert doctor.check_cores(64, None) == Check("cores", "ok", "64")
    assert doctor.check_cores(2, 2.0).status == "ok"
    check = doctor.check_cores(64, 1.5)
    assert (check.status, check.value) == ("warn", "64, of which the container is granted 1.5")
    assert check.remedy.startswith("--threads 2")
    assert doctor.check_cores(64, 0.1).remedy.startswith("--threads 1")


@pytest.mark.parametrize(
    ("files", "quota"),
    [
        ({"cpu.max": "150000 100000\n"}, 1.5),
        ({"cpu.max": "max 100000\n"}, None),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4.0),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
        ({"cpu.max": ""}, None),
        ({}, None),
    ],
)
def test_quota_of_a_container(files: dict[str, str], quota: float | None, tmp_path: Path) -> None:
    _write(tmp_path, files)
    assert doctor.core_quota(tmp_path) == quota


@pytest.mark.parametrize(
    ("system", "files", "available"),
    [
        (8_000_000, {}, 8_000_000),
        (8_000_000, {"memory.max": "max\n"}, 8_000_000),
        (8_000_000, {"memory.max": "1000000\n"}, 1_000_000),
        (8_000_000, {"memory/memory.limit_in_bytes": f"{2**63 - 4096}\n"}, 8_000_000),
        (8_000_000, {"memory/memory.limit_in_bytes": "5000000\n"}, 5_000_000),
        (None, {"memory.max": "1000000\n"}, 1_000_000),
        (None, {}, None),
    ],
)
def test_memory_of_a_container(
    system: int | None,
    files: dict[str, str],
    available: int | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def virtual_memory() -> SimpleNamespace:
        if system is None:
            raise FileNotFoundError(2, "No such file or directory", "/proc/meminfo")
        return SimpleNamespace(available=system)

    monkeypatch.setattr("psutil.virtual_memory", virtual_memory)
    _write(tmp_path, files)
    assert doctor.available_memory_bytes(tmp_path) == available


def _write(folder: Path, files: dict[str, str]) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(content)


@pytest.mark.parametrize(
    ("gigabytes", "memory", "disk"),
    [(0.1, "fail", "fail"), (0.9, "fail", "warn"), (3.0, "warn", "warn"), (8.0, "ok", "warn"), (50.0, "ok", "ok")],
)
def test_room(gigabytes: float, memory: Status, disk: Status) -> None:
    size = int(gigabytes * 1e9)
    checks = (doctor.check_memory(size), doctor.check_disk(size, Path("data")))
    assert [check.status for check in checks] == [memory, disk]
    for check in checks:
        assert check.value.startswith(f"{gigabytes:.1f} GB")
        assert bool(check.remedy) == (check.status != "ok")
    assert doctor.check_memory(None).status == "warn"


def test_a_folder_that_can_be_written(tmp_path: Path) -> None:
    assert doctor.check_writable(tmp_path).status == "ok"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/proc/1").is_dir(), reason="no /proc here")
def test_a_folder_that_cannot_be_written_even_by_root() -> None:
    check = doctor.check_writable(Path("/proc"))
    assert check.status == "fail"
    assert check.value.startswith("/proc: ")


def test_the_nearest_existing_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    assert nearest_existing(tmp_path / "a" / "b") == tmp_path
    assert nearest_existing(tmp_path / "file" / "b") == tmp_path
    assert nearest_existing(Path("a")) == Path.cwd()


TEXT = st.text(st.characters(blacklist_categories=("Cs", "Cc")), max_size=200)
CHECKS = st.lists(
    st.builds(Check, st.sampled_from(["Python", "libraries", "disk"]), st.sampled_from(STATUSES), TEXT, TEXT),
    min_size=1,
    max_size=9,
)


@given(CHECKS)
def test_the_table_fits_a_terminal(checks: list[Check]) -> None:
    lines = to_text(checks).splitlines()
    assert max(map(len, lines)) <= 80
    assert sum(re.match(r"(ok|warn|fail) ", line) is not None for line in lines) == len(checks)
    assert ("not ready" in lines[-1]) == (not is_fit(checks))


@given(CHECKS)
def test_json_holds_the_same(checks: list[Check]) -> None:
    answer = json.loads(to_json(checks))
    assert answer["ok"] == all(check.status != "fail" for check in checks)
    assert [Check(**entry) for entry in answer["checks"]] == checks


def test_the_table() -> None:
    checks = [
        Check("Python", "ok", "3.11.7"),
        doctor.check_libraries(("libSM.so.6", "libICE.so.6", "libGL.so.1", "libX11.so.6", "libXrender.so.1")),
        Check("devices", "fail", "crashed (SIGSEGV)", "see above"),
    ]
    assert to_text(checks) == (
        "ok    Python     3.11.7\n"
        "fail  libraries  missing libSM.so.6, libICE.so.6, libGL.so.1, libX11.so.6,\n"
        "                 libXrender.so.1\n"
        "                 -> as root: apt-get install libsm6 libice6 libgl1 libx11-6\n"
        "                    libxrender1\n"
        "fail  devices    crashed (SIGSEGV)\n"
        "                 -> see above\n"
        "not ready: 2 of 3 checks fail"
    )
