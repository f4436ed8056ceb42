"""``python -m synthetless`` is the command ``synthetless``."""

from synthetless.cli.app import main

main()
