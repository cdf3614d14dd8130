"""Typed settings and result files: a config node becomes a frozen, validated object or one clear line of error."""

import functools
import importlib
import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Final, ParamSpec, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from koopdqn.errors import BadInputError
from koopdqn.untrusted import TARGET as TARGET

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
    ("Value should ", "must "),
)
"""How the phrases of pydantic's messages read here."""


def flaw(error: ValidationError, skip: int = 0) -> str:
    """Return the first thing that is wrong: its dotted key, less the first ``skip`` parts, and what pydantic says."""
    first = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in first["loc"][skip:])
    return f"{key}: {first['msg']}" if key else first["msg"]


def _line(error: ErrorDetails, content: Mapping[str, Any], model: type[BaseModel], where: str) -> str:
    location = _within(error["loc"], content)
    if error["type"] == "extra_forbidden":
        owner = _model_at(model, location[:-1])
        valid = ", ".join(sorted(owner.model_fields)) if owner else "none"
        return f"unknown key {_dotted(where, location)}; valid: {valid}"
    if error["type"] == "missing":
        return f"{_dotted(where, [*location, error['loc'][-1]])}: must be given, found nothing"
    key = _dotted(where, location) or "the config"
    message = error["msg"]
    if error["type"] in ("model_type", "model_attributes_type", "dict_type"):
        message = "must be a group of keys"
    elif error["type"] in _OWN_CHECK:
        message = message.partition(", ")[2] or message
    for before, after in _WORDS:
        message = message.replace(before, after)
    message = " ".join(message.partition(" after validation")[0].split())
    # a model's own check sees all its fields at once and says itself what it found
    of_model = isinstance(error["input"], Mapping) and _model_at(model, location)
    if error["type"] in _OWN_CHECK and ("found" in message or of_model):
        return f"{key}: {message}"
    return f"{key}: {message}, found {shown(error['input'])}"


def _within(location: Sequence[int | str], content: object) -> list[int | str]:
    """Return the parts of an error's location that exist in the config; the others are pydantic's own additions."""
    inside: list[int | str] = []
    for part in location:
        holder = dict(enumerate(content)) if isinstance(content, list | tuple) else content
        if isinstance(holder, Mapping) and part in holder:
            content = holder[part]
            inside.append(part)
    return inside


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
    return next(filter(None, map(_model_in, typing.get_args(annotation))), None)


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


FARTHEST_M: Final = 10.0
"""No arm reaches so far [m]; lengths in millimetres or centimetres soon do."""

P = ParamSpec("P")
T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)


def typed(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function that checks its arguments by their annotations, where these are classes that exist.

    Raises:
        BadInputError: on a call, an argument is of another class.
    """
    signature = inspect.signature(function)
    known = {}
    for name, parameter in signature.parameters.items():
        classes = typing.get_args(parameter.annotation) or (parameter.annotation,)
        if parameter.kind is not parameter.VAR_POSITIONAL and all(isinstance(each, type) for each in classes):
            known[name] = classes

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if name in known and not isinstance(value, known[name]):
                wanted = [_full_name(each).removeprefix("builtins.") for each in known[name] if each is not NoneType]
                raise BadInputError(f"{name}: must be a {' or '.join(wanted)}, found {shown(value)}")
        return function(*args, **kwargs)

    return checked


class Settings(BaseModel):
    """Base of every settings class: immutable, no unknown keys, no coercion, no NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, protected_namespaces=())


class ReportModel(BaseModel):
    """Base of the parts of a result file, under the same rules.

    A key's description says what it holds; a unit stands in square brackets at its end, and holds for the keys
    below it too. Where nothing could be measured a value is None, which is null in JSON.
    """

    # Built when first used: a command needs few of the schemas that it imports.
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)


def _listed(items: str, length: int | None = None) -> Callable[[object], tuple[Any, ...]]:
    """Return a validator that turns a YAML list of these items into a tuple of that length."""

    def to_tuple(value: object) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple) or (length is not None and len(value) != length):
            raise ValueError(f"must be a list of {items if length is None else f'{length} {items}'}")
        return tuple(value)

    return to_tuple


def _to_path(value: object) -> object:
    if isinstance(value, str):
        if not value.strip():
            raise ValueError("must be a path")
        return Path(value)
    return value


def in_metres(farthest: float) -> AfterValidator:
    """Return a validator that refuses lengths [m] of which one is over the farthest, as millimetres would be."""

    def checked(values: tuple[float, float, float]) -> tuple[float, float, float]:
        if max(map(abs, values)) > farthest:
            raise ValueError(f"must be in metres and within {farthest:g} m")
        return values

    return AfterValidator(checked)


Positive = Annotated[float, Field(gt=0)]
"""A finite number above 0."""
NonNegative = Annotated[float, Field(ge=0)]
"""A finite number, 0 or above."""
Fraction = Annotated[float, Field(ge=0, le=1)]
"""A number from 0 to 1, both included."""
Count = Annotated[int, Field(ge=1)]
"""A whole number, 1 or above."""
NonNegativeInt = Annotated[int, Field(ge=0)]
"""A whole number, 0 or above."""
Name = Annotated[str, Field(min_length=1)]
"""A text that is not empty."""
Line = Annotated[str, Field(pattern=r"^[^\p{C}\p{Zl}\p{Zp}]+$")]
"""A text of one line, all of it visible: what is written into programs is no line of its own there."""
PathText = Annotated[Path, BeforeValidator(_to_path)]
"""A path, written as a text that is not empty; it need not exist."""
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
"""A SHA-256 in hexadecimal digits."""
Interval = Annotated[tuple[float, float], BeforeValidator(_listed("numbers", 2))]
"""Two numbers, as a YAML list: the lower and the upper bound (their order is for the owner to check)."""
Vector3 = Annotated[tuple[float, float, float], BeforeValidator(_listed("numbers", 3))]
"""Three numbers, as a YAML list."""
Metres3 = Annotated[Vector3, in_metres(FARTHEST_M)]
"""Three lengths [m], as a YAML list, such as a position; what can only be millimetres is refused."""
Vector4 = Annotated[tuple[float, float, float, float], BeforeValidator(_listed("numbers", 4))]
"""Four numbers, as a YAML list."""
Vector6 = Annotated[tuple[float, float, float, float, float, float], BeforeValidator(_listed("numbers", 6))]
"""Six numbers, as a YAML list."""
Vector7 = Annotated[tuple[float, float, float, float, float, float, float], BeforeValidator(_listed("numbers", 7))]
"""Seven numbers, as a YAML list: a pose (x y z [m], qw qx qy qz)."""
PoseList = Annotated[list[float], Field(min_length=7, max_length=7)]
"""A pose (x y z [m], qw qx qy qz) in a JSON file."""
Floats = Annotated[tuple[float, ...], BeforeValidator(_listed("numbers"))]
"""Any number of numbers, as a YAML list."""
Counts = Annotated[tuple[Count, ...], BeforeValidator(_listed("whole numbers"))]
"""Any number of whole numbers above 0, as a YAML list (layer widths)."""
Names = Annotated[tuple[Name, ...], BeforeValidator(_listed("texts"))]
"""Any number of texts, as a YAML list."""


def plain(node: Mapping[Any, Any] | None, where: str = "") -> dict[str, Any]:
    """Return a config node as plain dicts, lists and scalars, with its ``${…}`` resolved.

    Args:
        node: an OmegaConf node, or any mapping.
        where: dotted key of the node, for messages; "" for the root.

    Raises:
        BadInputError: the node is no mapping, a ``???`` is left open, or an interpolation fails.
    """
    from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if isinstance(node, DictConfig):
        try:
            content = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
        except MissingMandatoryValue as error:
            raise BadInputError(f"{error.full_key}: must be given, found ??? (nothing)") from error
        except OmegaConfBaseException as error:
            raise BadInputError(f"{error.full_key or where}: {_first_line(error)}") from error
    else:
        content = node
    if not isinstance(content, Mapping):
        raise BadInputError(f"{where or 'the config'}: must be a group of keys, found {shown(content)}")
    return {str(key): value for key, value in content.items()}


def validate(node: Mapping[Any, Any] | None, model: type[Model], where: str = "") -> Model:
    """Return ``model`` built from a config node; ``node`` and ``where`` are as of :func:`plain`.

    Raises:
        BadInputError: in one line, the dotted key, the rule and the value found; an unknown key lists
            the valid ones. Of several errors the first is told and the others are counted.
    """
    content = plain(node, where)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        # an unknown key is often a misspelling of one then reported missing, so it is the better line
        errors.sort(key=lambda e: e["type"] != "extra_forbidden")
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        raise BadInputError(_line(errors[0], content, model, where) + more) from error


def load_settings(node: Mapping[Any, Any] | None, base: type[T], where: str) -> T:
    """Return the object that a group's node describes.

    The node's ``target`` names a settings class that implements ``base`` (``"some.module.Class"``,
    also from a user's own package); the node's other keys are that class's fields.

    Args:
        node: an OmegaConf node, or any mapping.
        base: a class, or a ``runtime_checkable`` protocol.
        where: dotted key of the node, for messages.

    Raises:
        BadInputError: the target is absent, cannot be imported or does not implement ``base``, or the
            other keys break a rule (see `validate`).
    """
    content = plain(node, where)
    rule = f"{where}.{TARGET}: must name a class that implements {_full_name(base)}, found"
    if TARGET not in content:
        hint = f" (_target_ is written {TARGET} here)" if "_target_" in content else ""
        raise BadInputError(f"{rule} nothing{hint}")
    cls = _locate(content.pop(TARGET), where)
    found = _full_name(cls)
    # a protocol with data members is only decided on an instance, below
    if not getattr(base, "_is_protocol", False) and not issubclass(cls, base):
        raise BadInputError(f"{rule} {found}")
    if not issubclass(cls, BaseModel):
        raise BadInputError(f"{where}.{TARGET}: must name a subclass of {_full_name(Settings)}, found {found}")
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    if not missing:
        settings = validate(content, cls, where)
        if isinstance(settings, base):
            return settings
        parts = [*vars(base), *inspect.get_annotations(base)]
        missing = [name for name in parts if not name.startswith("_") and not hasattr(settings, name)]
    raise BadInputError(f"{rule} {found} without {', '.join(missing)}")


# Where classes were that runs of earlier commits name: they can still be evaluated.
_MOVED: Final = {
    "koopdqn.dqn.settings": "koopdqn.rl.settings",
    "koopdqn.feedback.file": "koopdqn.oracles.file",
    "koopdqn.feedback.imperfect": "koopdqn.oracles.scripted",
    "koopdqn.feedback.replay": "koopdqn.oracles.replay",
    "koopdqn.feedback.scripted": "koopdqn.oracles.scripted",
    "koopdqn.feedback.terminal.settings": "koopdqn.oracles.terminal",
    "koopdqn.intent.joint": "koopdqn.intent.separate",
    "koopdqn.intent.line": "koopdqn.intent.separate",
    "koopdqn.oracles.terminal.settings": "koopdqn.oracles.terminal",
}


def _locate(target: object, where: str) -> type[Any]:
    key = f"{where}.{TARGET}"
    if not isinstance(target, str) or "." not in target.strip("."):
        raise BadInputError(f"{key}: must be a dotted name such as some.module.Class, found {shown(target)}")
    module_name, _, class_name = target.rpartition(".")
    module_name = _MOVED.get(module_name, module_name)
    try:
        module = importlib.import_module(module_name)
    # a user's own module may raise anything while it is imported
    except Exception as error:
        reason = f"{type(error).__name__}: {_first_line(error)}"
        hint = "; the folder it lies in must be on PYTHONPATH" if isinstance(error, ModuleNotFoundError) else ""
        text = f"{key}: must name a class that can be imported, found {target!r} ({reason}){hint}"
        raise BadInputError(text) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        every = inspect.getmembers(module, lambda each: isinstance(each, type) and each.__module__ == module.__name__)
        classes = [name for name, _ in every if not name.startswith("_")]
        raise BadInputError(f"{key}: {module_name} has no class {class_name!r}; valid: {', '.join(classes) or 'none'}")
    return found


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _full_name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"
