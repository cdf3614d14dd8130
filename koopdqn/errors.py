"""The errors a user meets, each with the exit status it ends a command with."""

from collections.abc import Iterable


class KoopdqnError(Exception):
    """Base of every error that is told to the user as one line, without a traceback."""

    exit_status = 1


class BadInputError(KoopdqnError):
    """A config value, a file or an argument breaks a rule (exit status 2).

    The message names the quantity, the rule and the value found.
    """

    exit_status = 2


class WorkFailedError(KoopdqnError):
    """The input was good but the work itself failed: not learned, not reachable (exit status 1)."""


def unknown_name(kind: str, name: object, valid: Iterable[str]) -> BadInputError:
    """Return the error for a ``name`` that is not among the ``valid`` names of a ``kind`` of thing."""
    return BadInputError(f"unknown {kind} {name!r}; valid: {', '.join(sorted(valid))}")
