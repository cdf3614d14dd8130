"""``python -m koopdqn`` is the command ``koopdqn``."""

import sys

from koopdqn.cli import main

if __name__ == "__main__":
    sys.exit(main())
