"""Protobuf message classes from a table of fields: the wire format needs no more, and no compiler has to run."""

from __future__ import annotations

from collections.abc import Mapping

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

_SCALARS = {
    name: getattr(descriptor_pb2.FieldDescriptorProto, f"TYPE_{name.upper()}")
    for name in ("double", "float", "int32", "int64", "bool", "string", "bytes")
}


def message_classes(package: str, table: Mapping[str, Mapping[str, tuple[int, str]]]) -> dict[str, type[Message]]:
    """Make proto2 message classes.

    Enums are declared ``int32``: the same bytes, and a number that we do not know stays visible. The classes live in a
    pool of their own, so that they never clash with the official ones in the same process.

    Args:
        package: name of the proto package.
        table: message name -> field name -> (number, type). A type is a scalar or a message of the table; with ``*``
            it is repeated, with ``[]`` repeated and packed.

    Examples:
        >>> classes = message_classes("example", {"Point": {"x": (1, "double")}, "Line": {"points": (2, "Point*")}})
        >>> line = classes["Line"](points=[{"x": 1.5}])
        >>> classes["Line"].FromString(line.SerializeToString()).points[0].x
        1.5
    """
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto2")
    for message_name, fields in table.items():
        message = file.message_type.add(name=message_name)
        for field_name, (number, kind) in fields.items():
            _add_field(message, field_name, number, kind, package)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}")) for name in table}


def _add_field(message: descriptor_pb2.DescriptorProto, name: str, number: int, kind: str, package: str) -> None:
    base = kind.removesuffix("*").removesuffix("[]")
    field = message.field.add(name=name, number=number)
    field.label = field.LABEL_OPTIONAL if kind == base else field.LABEL_REPEATED
    if base in _SCALARS:
        field.type = _SCALARS[base]
    else:
        field.type, field.type_name = field.TYPE_MESSAGE, f".{package}.{base}"
    if kind.endswith("[]"):
        field.options.packed = True
