"""Option models: the single source of a stage's flags, config section, schema and defaults."""

import difflib
import shlex
import textwrap
import types
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator
from pydantic.fields import FieldInfo

from stages.shared.errors import THE_CONFIGURATION, OptionError

MAX_SEED = 2**31 - 1
"""Largest seed: OpenCV holds it in 32 bits, with a sign."""


class Options(BaseModel):
    """Base of every option model: unknown keys are refused, and values are immutable after validation.

    A number written as text ("1e-3", which YAML 1.1 reads as a string) is accepted as a number.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, allow_inf_nan=False, coerce_numbers_to_str=True
    )

    @field_validator("*", mode="before")
    @classmethod
    def _no_surprises(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false for a number; read an empty section as one with default values, and [all] as all.

        YAML 1.1 reads an unquoted yes or no as true or false.
        """
        annotation = cls.model_fields[str(info.field_name)].annotation
        if isinstance(value, bool) and (word := "yes" if value else "no") in allowed_words(annotation):
            return word
        if isinstance(value, bool) and annotation in (int, float):
            raise ValueError(f"a number of type {annotation.__name__}")
        if isinstance(value, list) and len(value) == 1 and value[0] in allowed_words(annotation):
            return value[0]  # a flag that takes several values holds a word as a list of one
        if annotation is int and isinstance(value, str) and _is_whole(value):
            return int(float(value))  # as "1e3"
        is_section = isinstance(annotation, type) and issubclass(annotation, Options)
        return {} if value is None and is_section else value


def _is_whole(text: str) -> bool:
    """Whether a text is a whole number, as "1e3" is, which YAML 1.1 reads as text."""
    try:
        return float(text).is_integer()
    except ValueError:
        return False


OptionsT = TypeVar("OptionsT", bound=Options)


def validate(model: type[OptionsT], values: Mapping[str, Any], where: str = THE_CONFIGURATION) -> OptionsT:
    """Build `model` from `values`.

    Args:
        where: source of the values, named before the option in messages, e.g. a stage or the name of a file.

    Raises:
        OptionError: one line for the first wrong option, with the nearest name if it is unknown.
    """
    try:
        return model(**_named(values, where))
    except ValidationError as error:
        raise _as_option_error(model, error.errors(), where) from error


def _named(values: Mapping[Any, Any], where: str) -> Mapping[str, Any]:
    """The values, whose keys YAML 1.1 may have read as numbers or as true, false and null."""
    for key in values:
        if not isinstance(key, str):
            raise OptionError([str(key)], "the name of an option", repr(key), "correct or quote it", where)
    return values


def to_flags(options: Options) -> str:
    """Command-line flags that rebuild `options`, with every field."""
    words: list[str] = []
    for name, value in options.model_dump(mode="json").items():
        flag = "--" + name.replace("_", "-")
        if isinstance(value, bool):
            words.append(flag if value else "--no-" + name.replace("_", "-"))
        elif isinstance(value, list):
            words += [flag, *map(str, value)]
        elif value is not None:
            words += [flag, str(value)]
    return shlex.join(words)


def _as_option_error(model: type[Options], errors: list[Any], where: str) -> OptionError:
    error, place = errors[0], errors[0]["loc"]
    # Pydantic reports each branch of a union, and a list without its wrong items: all of it is one mistake.
    branches = [other for other in errors if str(place[-1]).startswith("literal[") and _within(other, place[:-1])]
    others = sum(other not in branches and other["loc"] != place[: len(other["loc"])] for other in errors)
    location = [str(part) for part in error["loc"] if not str(part).startswith(("literal[", "list["))]
    name = ".".join(location)
    more = f" ({others} more wrong after it)" if others else ""
    if error["type"] == "extra_forbidden":
        known = _known_names(model, location[:-1])
        near = difflib.get_close_matches(location[-1], known, n=1)
        advice = f"did you mean '{near[0]}'?" if near else f"known here: {', '.join(sorted(known))}"
        return OptionError(location, "a known option", f"'{location[-1]}'", advice + more, where)
    if error["type"] == "missing":
        meanings = [found[location[-1]].description for found in _fields(model, location[:-1]) if location[-1] in found]
        meaning = f" ({meanings[0]})" if meanings and meanings[0] else ""
        return OptionError(location, f"a value{meaning}", "nothing", f"set '{name}'{more}", where)
    expected = " or ".join(dict.fromkeys(_expected(one) for one in branches or [error]))
    found = textwrap.shorten(repr(error["input"]), 80, placeholder=" ...")
    return OptionError(location, expected, found, f"correct '{name}'{more}", where)


def _within(error: Any, place: tuple[Any, ...]) -> bool:
    return bool(error["loc"][: len(place)] == place)


def _expected(error: Any) -> str:
    if error["type"] in ("tuple_type", "list_type"):
        return "a list"
    if error["type"] == "invalid_key":
        return "the name of an option"
    if error["type"] == "too_short":
        return f"a list of at least {error['ctx']['min_length']}"
    if error["type"] == "string_too_short":
        return "a path"
    return str(error["msg"].removeprefix("Input should be ").removeprefix("Value error, "))


def _known_names(model: type[Options], path: list[str]) -> list[str]:
    return [field.alias or name for fields in _fields(model, path) for name, field in fields.items()]


def _fields(model: type[Options], path: list[str]) -> list[dict[str, FieldInfo]]:
    """The fields at `path`, through lists and unions; a union's tag chooses the model of that name."""
    models = [model]
    for part in path:
        inner = [found for m in models if part in m.model_fields for found in _models(m.model_fields[part].annotation)]
        models = inner or [m for m in models if m.__name__.lower() == part] or models
    return [m.model_fields for m in models]


def allowed_words(annotation: Any) -> list[Any]:
    """The words that an annotation allows, alone or beside other values, as in Literal["all"] | tuple[int, ...]."""
    parts = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else [annotation]
    return [word for part in parts if get_origin(part) is Literal for word in get_args(part)]


def _models(annotation: Any) -> list[type[Options]]:
    """Every options model that an annotation mentions."""
    if isinstance(annotation, type) and issubclass(annotation, Options):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]
