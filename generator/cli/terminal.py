"""What reaches the terminal: printed text, and the one line and exit code that an error ends with."""

from __future__ import annotations

import os
import sys
import traceback
from typing import NoReturn

EXIT_FAILED, EXIT_WRONG_REQUEST, EXIT_BUG, EXIT_INTERRUPTED = 1, 2, 3, 130

_BUG = (
    "this is a bug in synthetless; please report it with the traceback above and the output of "
    "`synthetless doctor --json`"
)


def printable(text: str) -> str:
    """The text with everything escaped that would steer a terminal: file names and a server's words come from outside.

    Line feeds stay.
    """
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def say(text: object) -> None:
    """Print a result to stdout."""
    print(printable(str(text)))


def leave(message: str, code: int) -> NoReturn:
    """End with one line on stderr."""
    print(f"synthetless: {printable(' '.join(message.split()))}", file=sys.stderr)
    sys.exit(code)


def end(error: BaseException) -> NoReturn:
    """End with what an exception means for the user.

    A wrong request is one line and exit code 2, Ctrl-C one line and 130. Everything else is a fault of the program:
    its traceback, where to report it, and 3.
    """
    from synthetless.errors import UserError
    from synthetless.extras import EXTRAS, MissingExtraError
    from synthetless.scenes.blender import BlenderError

    match error:
        case KeyboardInterrupt():
            leave("interrupted", EXIT_INTERRUPTED)
        case UserError() | BlenderError():
            leave(str(error), EXIT_WRONG_REQUEST)
        case ModuleNotFoundError() if (package := (error.name or "").partition(".")[0]) in EXTRAS:
            leave(str(MissingExtraError(package)), EXIT_WRONG_REQUEST)
        case BrokenPipeError() if not _is_read():
            sys.exit(EXIT_FAILED)
        case OSError():
            place = f"{error.filename}: " if error.filename else ""
            leave(f"{place}{error.strerror or error}", EXIT_WRONG_REQUEST)
    print(printable("".join(traceback.format_exception(error))), end="", file=sys.stderr)
    leave(_BUG, EXIT_BUG)


def _is_read() -> bool:
    """Whether anybody still reads stdout; if not (`| head`), what is left to print is dropped without a complaint."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True
