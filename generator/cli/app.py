"""The entry point of the command line. It imports next to nothing, so that Ctrl-C ends in one line from the start."""

from __future__ import annotations

import sys

from synthetless.cli.terminal import end


def main() -> None:
    """Run the command that the arguments name; ends the process where it fails."""
    try:
        from synthetless.cli.commands import app

        try:
            app()
        finally:
            sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        end(error)
