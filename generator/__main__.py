"""``python -m generator`` is the command ``synthetless``."""

from generator.cli import main

main()
