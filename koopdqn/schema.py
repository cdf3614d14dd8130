"""The base of the schemas of result files."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError


class ReportModel(BaseModel):
    """Base of the parts of a report: immutable, no unknown keys, no coercion, no NaN or infinity.

    A key's description says what it holds; a unit stands in square brackets at its end, and holds for the keys
    below it too. Where nothing could be measured a value is None, which is null in JSON.
    """

    # Built when first used: a command needs few of the schemas that it imports.
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)


Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
"""A SHA-256 in hexadecimal digits."""


def flaw(error: ValidationError, skip: int = 0) -> str:
    """Return the first thing that is wrong: its dotted key, less the first ``skip`` parts, and what pydantic says."""
    first = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"][skip:])
    return f"{key}: {first['msg']}" if key else first["msg"]
