"""Changing demonstration files as another program would that knows nothing of their checksum."""

from pathlib import Path


def unsealed(path: Path) -> None:
    """Take the checksum out of a demonstration file."""
    with path.open("r+b") as file:
        file.write(bytes(512))
