"""``python -m koopdqn`` is the command ``koopdqn``."""

import sys

from koopdqn.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
