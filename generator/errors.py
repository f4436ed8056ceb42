"""What a command tells its user in one line."""

from __future__ import annotations


class UserError(ValueError):
    """A request, a file or a machine that the user can mend; the message says what was wrong and what would be right.

    The command line prints the message as one line and ends with exit code 2. Every other exception is a fault of the
    program and keeps its traceback.
    """
