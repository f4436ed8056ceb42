"""``python -m synthetless`` is the command ``synthetless``."""

from synthetless.cli.app import main

if __name__ == "__main__":
    main()
