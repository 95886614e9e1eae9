"""Single numbers read from memory and written to it. With lanes a buffer holds the numbers of all lanes side by side."""

from typing import Any

import numpy as np

from .arrays import Buffer
from .dtypes import BYTES
from .instructions import Instructions
from .values import Complex, Index, Number, Run, Value, parts


def load(code: Instructions, buffer: Buffer, place: Index) -> Any:
    """A number."""
    if buffer.parts == 1:
        return _loaded(code, buffer, place)
    return Complex(*(_loaded(code, buffer, _part(code, buffer, place, k)) for k in range(2)))


def store(code: Instructions, buffer: Buffer, place: Index, x: Number) -> None:
    """Stores a number, in the lanes that take part."""
    if buffer.parts == 1:
        _store(code, buffer, place, x)
        return
    for k, part in enumerate(parts(x)):
        _store(code, buffer, _part(code, buffer, place, k), part)


def address_of(code: Instructions, buffer: Buffer, place: Index) -> str:
    """The address of a number that is in one place for all lanes."""
    if isinstance(place, int) and place == 0:
        return buffer.pointer
    assert not buffer.apart
    place = code.times(place, 2) if buffer.parts == 2 and not buffer.plane else place
    address, lanes = _address(code, buffer, place)
    assert not lanes
    return address


def _part(code: Instructions, buffer: Buffer, place: Index, k: int) -> Any:
    """Where the k-th part of a complex number is."""
    return code.plus(place, k * buffer.plane) if buffer.plane else code.plus(code.times(place, 2), k)


def _stored(buffer: Buffer) -> str:
    return "i8" if buffer.kind == "i1" else buffer.kind


def _address(code: Instructions, buffer: Buffer, place: Index) -> tuple[str, str]:
    """The address of a number; or of the first where the lanes' numbers follow one another ("run"); or a vector of addresses ("each")."""
    if isinstance(place, Run) and not buffer.lanes:
        return _address(code, buffer, place.base)[0], "run"
    each = isinstance(place, Value) and place.lanes
    if buffer.apart:
        place = code.times(place, Value("%threads", "i64"))
    if buffer.lanes:
        place = code.times(place, code.width)
        if each and isinstance(place, Value):
            lane = ", ".join(f"i64 {k}" for k in range(code.width))
            place = code.pure(f"add {code.type('i64', True)} {place.name}, <{lane}>", "i64", True)
    index = code.operand(place, "i64", each)
    out = code.pure(f"getelementptr {_stored(buffer)}, ptr {buffer.pointer}, {index}", "ptr", each)
    return out.name, "each" if each else ""


def _active(code: Instructions) -> str:
    """The lanes that take part."""
    return f"{code.type('i1', True)} {code.text(code.mask, 'i1', True) if code.mask else 'splat (i1 true)'}"


def _loaded(code: Instructions, buffer: Buffer, place: Index) -> Value:
    stored = _stored(buffer)
    address, lanes = _address(code, buffer, place)
    vector = code.type(stored, bool(lanes) or buffer.lanes)
    if lanes == "each":
        full = f"llvm.masked.gather.v{code.width}{_suffix(stored)}.v{code.width}p0"
        pointers = code.type("ptr", True)
        function = code.function(full, vector, pointers, code.type("i1", True), vector)
        aligned = f"{pointers} align {BYTES[stored]} {address}"
        text = f"call {vector} {function}({aligned}, {_active(code)}, {vector} zeroinitializer)"
    else:
        text = f"load {vector}, ptr {address}, align {BYTES[stored]}"
    x = code.write(text, stored, bool(lanes) or buffer.lanes)
    return code.cast("trunc", x, "i1") if buffer.kind == "i1" else x


def _store(code: Instructions, buffer: Buffer, place: Index, x: Number) -> None:
    stored = _stored(buffer)
    if buffer.kind == "i1":
        x = code.cast("zext", x, "i8") if isinstance(x, Value) else np.int8(bool(x))
    address, lanes = _address(code, buffer, place)
    number, each = code.operand(x, stored, buffer.lanes or bool(lanes)), lanes == "each"
    if not each and code.mask is None:
        code.lines.append(f"store {number}, ptr {address}, align {BYTES[stored]}")
        return
    to = code.type("ptr", True) if each else "ptr"
    name, pointers = ("scatter", f"v{code.width}") if each else ("store", "")
    full = f"llvm.masked.{name}.v{code.width}{_suffix(stored)}.{pointers}p0"
    function = code.function(full, "void", code.type(stored, True), to, code.type("i1", True))
    code.lines.append(f"call void {function}({number}, {to} align {BYTES[stored]} {address}, {_active(code)})")


def _suffix(kind: str) -> str:
    return kind.replace("double", "f64").replace("float", "f32")
