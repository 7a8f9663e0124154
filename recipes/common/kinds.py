"""Whether an option is of the kind that its reader's annotation says: YAML and command lines may say anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from recipes.common.limits import LISTS, WORDS, is_number

SCALARS = (int, float, bool, str, NoneType)


def check_kinds(target: Callable[..., Any], options: Mapping[str, Any], name: str) -> None:
    """Refuse values that the annotations of a function or class rule out.

    Numbers, flags, texts, null, and mappings and sequences of these are judged; any other annotation is left to the
    target.

    Args:
        target: whose keyword arguments the options become.
        options: their values.
        name: of the section.

    Raises:
        ValueError: naming the option and its value.

    Examples:
        >>> def sight(pieces: int, bins: dict[str, tuple[float, float]], far: float | None = None) -> None: ...
        >>> check_kinds(sight, {"pieces": 4, "bins": {"vehicle": [0.3, 1]}, "far": None}, "model.context")
        >>> check_kinds(sight, {"pieces": "many"}, "model.context")
        Traceback (most recent call last):
        ...
        ValueError: model.context.pieces must be a whole number, got 'many'.
        >>> check_kinds(sight, {"bins": {"vehicle": [0.3, "wide"]}}, "model.context")
        Traceback (most recent call last):
        ...
        ValueError: model.context.bins.vehicle must be a list of numbers, got [0.3, 'wide'].
    """
    hints = get_type_hints(target.__init__ if isinstance(target, type) else target)
    for option, value in options.items():
        if option in hints:
            _check(value, hints[option], f"{name}.{option}")


def _check(value: Any, hint: Any, name: str) -> None:
    if get_origin(hint) is not None and _is(hint, Mapping) and isinstance(value, Mapping):
        for key, each in value.items():
            _check(each, get_args(hint)[1], f"{name}.{key}")
    elif not _fits(value, hint):
        raise ValueError(f"{name} must be {_words(hint)}, got {value!r}.")


def _fits(value: Any, hint: Any) -> bool:
    if get_origin(hint) in (Union, UnionType):
        return any(_fits(value, each) for each in get_args(hint))
    if hint is float:
        return is_number(value)
    if hint in SCALARS:
        return type(value) is hint
    if _is(hint, Mapping):
        return isinstance(value, Mapping)
    if _is(hint, Sequence):
        kinds = [each for each in get_args(hint) if each is not Ellipsis] or [object]
        return isinstance(value, list | tuple) and all(any(_fits(each, kind) for kind in kinds) for each in value)
    return True


def _is(hint: Any, kind: type) -> bool:
    """Whether an annotation is one of mappings, or of sequences."""
    origin = get_origin(hint) or hint
    return isinstance(origin, type) and issubclass(origin, kind) and origin is not str


def _words(hint: Any) -> str:
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(_words(each) for each in get_args(hint))
    if _is(hint, Sequence):
        return LISTS.get(next(iter(get_args(hint)), None), WORDS[list])
    if _is(hint, Mapping):
        return WORDS[dict]
    return "null" if hint is NoneType else WORDS.get(hint, str(hint))
