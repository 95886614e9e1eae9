"""Whether compiled code can be trusted on this machine: a small batch is computed before the first function is compiled."""

import ctypes
import functools
import math
import warnings
from collections.abc import Callable

from .interface import NUMBERS, OFFSETS, batch_size, buffer, offset
from .programs import guarded, handler, register
from .runtime import in_threads
from .target import Target, compiles_here, host
from .vector_math import vector_function


def available() -> bool:
    """Whether code for this machine can be made; if not, XLA does the work, and a warning has said why."""
    return compiles_here() and _is_right(host())


@guarded
@functools.cache
def _is_right(target: Target) -> bool:
    try:
        wrong = _wrong(target)
    except Exception as error:  # whatever LLVM, ctypes or XLA say: there is another way
        wrong = repr(error)
    if wrong is not None:
        warnings.warn(
            f"dae_jax leaves all kernels to XLA, as its own compiler does not work here: {wrong}",
            RuntimeWarning,
            stacklevel=4,
        )
    return wrong is None


def _wrong(target: Target) -> str | None:
    """What a batch of two vectors gives wrong, called as XLA would."""
    xs = [0.25 * k - 0.5 for k in range(2 * target.width)]
    ys = (ctypes.c_double * len(xs))()
    if _call(handler(register(_module(target.width))), (ctypes.c_double * len(xs))(*xs), ys):
        return "it gave an error"
    for x, y in zip(xs, ys, strict=True):
        expected = math.exp(x) + x if x < 1 else 3 * math.sin(x)
        if not abs(y - expected) <= 1e-14 * abs(expected):
            return f"it computes {y!r} where {expected!r} is right"
    return None


def _module(width: int) -> str:
    """x < 1 ? eˣ + x : sin x + sin x + sin x: a loop, a choice, functions for numbers and for vectors, a batch."""
    vector = f"<{width} x double>"
    many = vector_function("exp", 1)
    lanes = [
        line
        for k in range(width)
        for line in (
            f"%x{k} = extractelement {vector} %x, i64 {k}",
            f"%y{k} = call double @exp(double %x{k})",
            f"%e{k} = insertelement {vector} {f'%e{k - 1}' if k else 'poison'}, double %y{k}, i64 {k}",
        )
    ]
    exponential = (
        [f"%e = call {vector} @{many}({vector} %x)"]
        if many
        else [*lanes, f"%e = fadd {vector} %e{width - 1}, splat (double -0.0)"]
    )
    body = [
        *buffer("%args", 0, "arg0"),
        *buffer("%results", 0, "result0"),
        *batch_size("arg0"),
        "br label %next",
        "next:",
        f"%start = atomicrmw add ptr %taken, i64 {width} monotonic",
        "%left = icmp slt i64 %start, %batch",
        "br i1 %left, label %some, label %done",
        "some:",
        "%from = getelementptr double, ptr %arg0, i64 %start",
        f"%x = load {vector}, ptr %from, align 8",
        *exponential,
        "br label %head",
        "head:",
        "%k = phi i64 [ 0, %some ], [ %k.next, %lane ]",
        f"%s = phi {vector} [ zeroinitializer, %some ], [ %s.next, %lane ]",
        f"%all = icmp eq i64 %k, {width}",
        "br i1 %all, label %choose, label %lane",
        "lane:",
        f"%xk = extractelement {vector} %x, i64 %k",
        "%sk = call double @sin(double %xk)",
        f"%s.next = insertelement {vector} %s, double %sk, i64 %k",
        "%k.next = add i64 %k, 1",
        "br label %head",
        "choose:",
        f"%sum = fadd {vector} %e, %x",
        f"%three = fmul {vector} %s, splat (double 3.0)",
        f"%small = fcmp olt {vector} %x, splat (double 1.0)",
        f"%y = select <{width} x i1> %small, {vector} %sum, {vector} %three",
        "%to = getelementptr double, ptr %result0, i64 %start",
        f"store {vector} %y, ptr %to, align 8",
        "br label %next",
        "done:",
    ]
    declared = [
        "declare double @sin(double)",
        f"declare {vector} @{many}({vector})" if many else "declare double @exp(double)",
    ]
    found = [*buffer("%args", 0, "arg0"), *batch_size("arg0")]
    return "\n".join([*declared, *in_threads(body, found, width)])


def _call(handler: Callable[[int], int | None], xs: ctypes.Array, ys: ctypes.Array) -> int | None:
    """The handler's answer to a call with one argument and one result."""
    keep = []

    def struct(name: str, extra: int = 0, **fields: int) -> int:
        memory = ctypes.create_string_buffer(max(OFFSETS[f"XLA_FFI_{name}"].values()) + 8 + extra)
        keep.append(memory)
        for field, value in fields.items():
            size = 4 if field == "stage" else 8
            at = offset(name, field)
            memory[at : at + size] = value.to_bytes(size, "little")
        return ctypes.addressof(memory)

    def array(of: ctypes.Array) -> int:
        dims, pointer = (ctypes.c_int64 * 1)(len(of)), (ctypes.c_int64 * 1)()
        pointer[0] = struct("Buffer", data=ctypes.addressof(of), dims=ctypes.addressof(dims))
        keep.extend([dims, pointer])
        return ctypes.addressof(pointer)

    frame = struct("CallFrame", struct_size=offset("CallFrame"), stage=NUMBERS["XLA_FFI_ExecutionStage_EXECUTE"])
    for field, inner, of in (("args", "args", xs), ("rets", "rets", ys)):
        place = frame + offset("CallFrame", field) + offset(field.capitalize(), inner)
        ctypes.c_int64.from_address(place).value = array(of)
    return handler(frame)
