"""Whether an option is of the kind that its reader's annotation says: YAML and command lines may say anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import Signature, isclass, isfunction, signature
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from recipes.common.limits import LISTS, WORDS, is_number

SCALARS = (int, float, bool, str, NoneType)


def taken_by(target: Callable[..., Any]) -> Signature:
    """What a function or class is called with.

    Python before 3.11.4 takes it from the ``__new__`` of a base where a class inherits its ``__init__``, as losses do.

    Examples:
        >>> from dpa.losses import PlackettLuceLoss
        >>> "alpha" in taken_by(PlackettLuceLoss).parameters
        True
    """
    if not (isclass(target) and isfunction(target.__init__)):
        return signature(target)
    _, *taken = signature(target.__init__).parameters.values()
    return Signature(taken)


def check_kinds(target: Callable[..., Any], options: Mapping[str, Any], name: str) -> None:
    """Refuse values that the annotations of a function or class rule out.

    Numbers, flags, texts, null, and mappings and sequences of these are judged; any other annotation, and one that
    cannot be read, is left to the target. A default may be what its annotation is not.

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
        >>> check_kinds(sight, {"bins": {"vehicle": [0.3]}}, "model.context")
        Traceback (most recent call last):
        ...
        ValueError: model.context.bins.vehicle must be a list of 2 numbers, got [0.3].
    """
    hints, known = _hints(target), taken_by(target).parameters
    for option, value in options.items():
        if option in hints and not (option in known and _same(value, known[option].default)):
            _check(value, hints[option], f"{name}.{option}")


def _hints(target: Callable[..., Any]) -> Mapping[str, Any]:
    while isinstance(target, partial):
        target = target.func
    # Fields of a dataclass may be of a base in another module; a NamedTuple has no __init__ of its own.
    by_fields = isclass(target) and ("__dataclass_fields__" in vars(target) or not isfunction(target.__init__))
    try:
        return get_type_hints(target.__init__ if isclass(target) and not by_fields else target)
    except (NameError, TypeError):
        return {}


def _same(value: Any, default: Any) -> bool:
    return type(value) is type(default) and value == default


def _check(value: Any, hint: Any, name: str) -> None:
    if _is(hint, Mapping) and isinstance(value, Mapping):
        inner = get_args(hint)[1] if len(get_args(hint)) == 2 else object
        for key, each in value.items():
            _check(each, inner, f"{name}.{key}")
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
        length, kinds = _length(hint), [each for each in get_args(hint) if each is not Ellipsis] or [object]
        right = isinstance(value, list | tuple) and length in (None, len(value))
        return right and all(any(_fits(each, kind) for kind in kinds) for each in value)
    return True


def _is(hint: Any, kind: type) -> bool:
    """Whether an annotation is one of mappings, or of sequences."""
    origin = get_origin(hint) or hint
    return isinstance(origin, type) and issubclass(origin, kind) and not issubclass(origin, str | bytes)


def _length(hint: Any) -> int | None:
    """Of a tuple that has one."""
    args = get_args(hint)
    return len(args) if get_origin(hint) is tuple and Ellipsis not in args else None


def _words(hint: Any) -> str:
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(_words(each) for each in get_args(hint))
    if _is(hint, Sequence):
        words, length = LISTS.get(next(iter(get_args(hint)), None), "a list of values"), _length(hint)
        return words if length is None else words.replace("of ", f"of {length} ", 1)
    if _is(hint, Mapping):
        return WORDS[dict]
    return "null" if hint is NoneType else WORDS.get(hint, str(hint))
