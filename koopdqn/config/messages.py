"""One line for what pydantic found wrong with a config: dotted key, rule, value found."""

import typing
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

_OWN_CHECK = ("value_error", "assertion_error")
_WORDS = (
    ("Input should be a valid tuple", "must be a list"),
    ("Input should be a valid list", "must be a list"),
    ("Input should be a valid boolean", "must be true or false"),
    ("Input should be a valid integer", "must be a whole number"),
    ("Input should be a valid string", "must be a text"),
    ("Input should be a valid ", "must be a "),
    ("Input should be an instance of Path", "must be a path"),
    ("Input should ", "must "),
    ("String should ", "must "),
    ("Tuple should ", "must "),
    ("List should ", "must "),
)
"""How the phrases of pydantic's messages read here."""


def describe(error: ValidationError, content: Mapping[str, Any], model: type[BaseModel], where: str) -> str:
    """Return one line that names the first thing wrong and counts the others.

    Args:
        error: what building ``model`` from ``content`` raised.
        content: the config that was refused.
        model: the settings class.
        where: dotted key of ``content``; "" for the root of the config.
    """
    errors = error.errors(include_url=False)
    # an unknown key is often a misspelling of one then reported missing, so it is the better line
    errors.sort(key=lambda e: e["type"] != "extra_forbidden")
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return _line(errors[0], content, model, where) + more


def _line(error: ErrorDetails, content: Mapping[str, Any], model: type[BaseModel], where: str) -> str:
    location, rest = _within(error["loc"], content)
    if error["type"] == "extra_forbidden":
        owner = _model_at(model, location[:-1])
        valid = ", ".join(sorted(owner.model_fields)) if owner else "none"
        return f"unknown key {_dotted(where, location)}; valid: {valid}"
    if error["type"] == "missing":
        return f"{_dotted(where, [*location, *rest[-1:]])}: must be given, found nothing"
    key = _dotted(where, location) or "the config"
    message = error["msg"]
    if error["type"] in ("model_type", "model_attributes_type", "dict_type"):
        message = "must be a group of keys"
    elif error["type"] in _OWN_CHECK:
        message = message.partition(", ")[2] or message
    message = _in_house_words(message)
    # a model's own check sees all its fields at once and says itself what it found
    if error["type"] in _OWN_CHECK and ("found" in message or isinstance(error["input"], Mapping)):
        return f"{key}: {message}"
    return f"{key}: {message}, found {shown(error['input'])}"


def _in_house_words(message: str) -> str:
    for before, after in _WORDS:
        message = message.replace(before, after)
    return " ".join(message.partition(" after validation")[0].split())


def _within(location: Sequence[int | str], content: object) -> tuple[list[int | str], list[int | str]]:
    """Split an error's location into what exists in the config and pydantic's own additions."""
    inside: list[int | str] = []
    rest: list[int | str] = []
    for part in location:
        holder = dict(enumerate(content)) if isinstance(content, list | tuple) else content
        if isinstance(holder, Mapping) and part in holder:
            content = holder[part]
            inside.append(part)
        else:
            rest.append(part)
    return inside, rest


def _model_at(model: type[BaseModel], location: Sequence[int | str]) -> type[BaseModel] | None:
    found: type[BaseModel] | None = model
    for part in location:
        if isinstance(part, int):
            continue
        field = found.model_fields.get(part) if found else None
        found = _model_in(field.annotation) if field else None
    return found


def _model_in(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in typing.get_args(annotation):
        found = _model_in(argument)
        if found:
            return found
    return None


def _dotted(where: str, location: Sequence[int | str]) -> str:
    text = where
    for part in location:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            name = part if part.isprintable() else repr(part)
            text = f"{text}.{name}" if text else name
    return text


def shown(value: object) -> str:
    """Return a value as error messages show it: its repr on one line, cut at 80 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else text[:77] + "..."
