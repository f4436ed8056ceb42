"""How a command ends, whatever happens to it, and that nothing printed steers the terminal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from fetch_server import Handler, running

from synthetless.cli.app import main
from synthetless.cli.terminal import printable
from synthetless.doctor import Check
from synthetless.errors import UserError
from synthetless.scenes.blender import BlenderError

ENDINGS: dict[str, tuple[BaseException, int, str]] = {
    "wrong request": (UserError("n is -1;\na positive number is needed"), 2, "n is -1; a positive number is needed"),
    "no Blender": (BlenderError("Blender is not installed"), 2, "Blender is not installed"),
    "missing file": (FileNotFoundError(2, "No such file or directory", "a.ply"), 2, "a.ply: No such file or directory"),
    "no file": (OSError(28, "No space left on device"), 2, "No space left on device"),
    "no errno": (OSError("cut off"), 2, "cut off"),
    "steering name": (FileNotFoundError(2, "No such file", "\x1b[31m.ply"), 2, r"\x1b[31m.ply: No such file"),
    "interrupted": (KeyboardInterrupt(), 130, "interrupted"),
}

BUGS: dict[str, BaseException] = {
    "wrong value": ValueError("operands could not be broadcast"),
    "end of file": EOFError("Ran out of input"),
    "no memory": MemoryError(),
    "recursion": RecursionError("maximum recursion depth exceeded"),
    "failed assertion": AssertionError(),
    "steering": KeyError("\x1b[31m"),
}


def _end(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> int:
    """The exit code of `synthetless doctor`, in which this is raised."""

    def examine(*_: object) -> None:
        raise error

    monkeypatch.setattr("synthetless.doctor.examine", examine)
    monkeypatch.setattr(sys, "argv", ["synthetless", "doctor"])
    with pytest.raises(SystemExit) as stop:
        main()
    return int(stop.value.code or 0)


@pytest.mark.parametrize("kind", ENDINGS)
def test_what_the_user_can_mend_is_one_line(
    kind: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    error, code, line = ENDINGS[kind]
    assert _end(error, monkeypatch) == code
    assert capfd.readouterr().err == f"synthetless: {line}\n"


@pytest.mark.parametrize("kind", BUGS)
def test_a_bug_keeps_its_traceback_and_says_where_to_report_it(
    kind: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert _end(BUGS[kind], monkeypatch) == 3
    *trace, hint = capfd.readouterr().err.splitlines()
    assert trace[0].startswith("Traceback")
    assert type(BUGS[kind]).__name__ in trace[-1]
    assert "bug in synthetless" in hint
    assert "synthetless doctor --json" in hint
    assert "\x1b" not in "".join(trace)


@pytest.mark.parametrize("module", ["typer", "synthetless.cli.commands", "synthetless.doctor"])
def test_an_interrupt_during_imports_is_one_line(module: str, tmp_path: Path) -> None:
    """Ctrl-C while the command, or what the command needs, is being imported."""
    code = (
        "import os, signal, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from synthetless.cli.app import main\n"
        "sys.argv = ['synthetless', 'doctor']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "synthetless: interrupted\n")


def test_an_interrupt_of_a_running_command_is_one_line() -> None:
    code = (
        "import sys, time\n"
        "from synthetless import doctor\n"
        "from synthetless.cli.app import main\n"
        "doctor.examine = lambda folder: (print('begun', flush=True), time.sleep(600))\n"
        "sys.argv = ['synthetless', 'doctor']\n"
        "main()\n"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline() == "begun\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate()
    assert (process.returncode, err) == (130, "synthetless: interrupted\n")


def test_a_reader_that_has_gone_is_no_fault() -> None:
    """As in `synthetless --help | true`."""
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-m", "synthetless", "--help"], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("part.ply", "part.ply"),
        ("a\nb", "a\nb"),
        ("naïve Größe 部品 μ", "naïve Größe 部品 μ"),
        ("\x1b[2J\x07", r"\x1b[2J\x07"),
        ("\r\t\x7f", r"\r\t\x7f"),
        ("\x9b31m", r"\x9b31m"),
        ("\u202egpj.exe", r"\u202egpj.exe"),
        ("a\u2028b\u200bc", r"a\u2028b\u200bc"),
        (os.fsdecode(b"caf\xe9"), r"caf\udce9"),
        ("\U000e0041", r"\U000e0041"),
    ],
)
def test_what_steers_a_terminal_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


@pytest.mark.parametrize("name", ["\x1b[31mred", "a\x07\x7fb", os.fsdecode(b"\xff\xfe"), "\u202eabc"])
def test_foreign_names_are_printed_escaped(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """In an error, and in a report on stdout."""
    folder = tmp_path / name
    monkeypatch.setattr("synthetless.doctor.examine", lambda out: [Check("disk", "fail", str(out), f"leave {out}")])
    for command, code in ((["validate", str(folder)], 2), (["doctor", "--out", str(folder)], 1)):
        monkeypatch.setattr(sys, "argv", ["synthetless", *command])
        with pytest.raises(SystemExit) as stop:
            main()
        printed = "".join(capfd.readouterr())
        assert stop.value.code == code
        assert printable(name) in printed
        assert all(c.isprintable() or c == "\n" for c in printed)


def test_the_words_of_a_server_are_printed_escaped(tmp_path: Path) -> None:
    """In a warning, since the server may recover, and in the error that ends the command."""

    def evil(status: int) -> Callable[[Handler], None]:
        def reply(handler: Handler) -> None:
            handler.send_response(status, "no \x1b[2J\x1b]0;title\x07 way")
            handler.end_headers()

        return reply

    with running() as server:
        server.script = [evil(503), evil(403)]
        done = subprocess.run(
            [sys.executable, "-m", "synthetless", "fetch", "dtd", "--to", "out", "--from", server.url],
            env={**os.environ, "no_proxy": "127.0.0.1"},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert [line.count(r"no \x1b[2J\x1b]0;title\x07 way") for line in done.stderr.splitlines()] == [1, 1]
    assert "\x1b" not in done.stderr
