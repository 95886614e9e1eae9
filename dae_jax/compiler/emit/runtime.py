"""What every compiled function shares, in machine code: the handler that XLA calls, and the work of a batch in threads.

A function is reached through a slot, so that its code can be let go and loaded again: (address or null, calls that are
running, when it was last used). XLA keeps the address of a handler for the life of the process: it is a stub, which calls
`handle` with its slot.

A batch is shared out among threads of XLA's own pool, which is the only one of the process. Nobody waits for a thread that
has not begun: the caller computes what no other thread takes, so that a pool that is busy, gone (in a child process), or not
there costs time only.
"""

import re
from pathlib import Path

from .interface import NUMBERS, VERSION, offset
from .vector_math import has_symbol


# Fewer vectors than these are not worth the 5 µs until another thread has begun.
VECTORS = 4
SLOT_BYTES = 64
# How many threads of a GPU are stood in for here.
THREADS_IN_TURN = 3
# How many handlers are made at a time.
STUBS = 32
# The symbols that functions of all modules can name.
HANDLE, SHARE = "dae_jax_handle_3", "dae_jax_share_3"

_AFFINITY = ("sched_getaffinity", "getpid")
_WAITING = (
    "pthread_mutex_init", "pthread_mutex_lock", "pthread_mutex_unlock", "pthread_mutex_destroy", "pthread_cond_init",
    "pthread_cond_wait", "pthread_cond_signal", "pthread_cond_destroy",
)  # fmt: skip


def stubs() -> str:
    """The module of `STUBS` handlers and their slots."""
    lines = [
        f"@slots = global [{STUBS} x [{SLOT_BYTES} x i8]] zeroinitializer, align {SLOT_BYTES}",
        f"declare ptr @{HANDLE}(ptr, ptr)",
    ]
    for k in range(STUBS):
        slot = f"getelementptr (i8, ptr @slots, i64 {k * SLOT_BYTES})"
        lines += [
            f"define ptr @stub{k}(ptr %frame) {{",
            f"%error = tail call ptr @{HANDLE}(ptr %frame, ptr {slot})",
            "ret ptr %error",
            "}",
        ]
    return "\n".join(lines)


def alone(body: list[str], longest: bool) -> list[str]:
    """The kernel that does what `body` says of the buffers %args and %results; `longest`: by the longest vectors."""
    width = '"prefer-vector-width"="512" ' if longest else ""
    head = f"define i32 @{{name}}.kernel(ptr %frame, ptr %args, ptr %results) {width}{{"
    return [head, "entry:", *body, "ret i32 0", "}"]


def in_threads(body: list[str], find_batch: list[str], width: int) -> list[str]:
    """The same for a batch of vectors of `width` elements, in as many threads as are free and of use.

    `body` takes elements from the counter %taken, which the threads share; `find_batch` are the instructions that find %batch.
    """
    return [
        f"declare i32 @{SHARE}(ptr, ptr, ptr, ptr, i64)",
        "define i32 @{name}.work(ptr %args, ptr %results, ptr %taken) {",
        "entry:",
        *body,
        "ret i32 0",
        "}",
        "define i32 @{name}.kernel(ptr %frame, ptr %args, ptr %results) {",
        "entry:",
        *find_batch,
        f"%more = add i64 %batch, {width - 1}",
        f"%vectors = udiv i64 %more, {width}",
        f"%status = call i32 @{SHARE}(ptr %frame, ptr @{{name}}.work, ptr %args, ptr %results, i64 %vectors)",
        "ret i32 %status",
        "}",
    ]


def in_turn(body: list[str], room: int) -> list[str]:
    """The same for a batch as a GPU's threads do it, `THREADS_IN_TURN` of them and one after another.

    `body` finds %batch, begins with element %first and goes on in steps of %threads; of the buffer %room each thread has so many
    bytes.
    """
    calls = [f"call void @{{name}}.thread(ptr %args, ptr %results, i64 {k}, ptr %room)" for k in range(THREADS_IN_TURN)]
    return [
        "define internal void @{name}.thread(ptr %args, ptr %results, i64 %first, ptr %room) {",
        "entry:",
        f"%threads = add i64 {THREADS_IN_TURN}, 0",
        *body,
        "ret void",
        "}",
        *alone(
            [f"%room = call ptr @malloc(i64 {room * THREADS_IN_TURN + 64})", *calls, "call void @free(ptr %room)"],
            False,
        ),
    ]


def procedure(name: str, parameters: list[str], body: list[str], longest: bool) -> list[str]:
    """A function that kernels of its module call; `longest`: by the longest vectors."""
    width = '"prefer-vector-width"="512" ' if longest else ""
    head = f"define internal fastcc void {name}({', '.join(parameters)}) noinline nounwind {width}{{"
    return [head, "entry:", *body, "ret void", "}"]


def heap(size: int) -> tuple[list[str], list[str]]:
    """The instructions that take %heap, aligned memory of so many bytes, and those that give it back.

    Where there is none the function ends with 1. They come in a block called `entry` and end in one called `taken`.
    """
    take = [
        f"%heap.raw = call ptr @malloc(i64 {size + 64})",
        "%heap.none = icmp eq ptr %heap.raw, null",
        "br i1 %heap.none, label %heap.fails, label %heap.taken",
        "heap.fails:",
        "ret i32 1",
        "heap.taken:",
        "%heap.int = ptrtoint ptr %heap.raw to i64",
        "%heap.up = add i64 %heap.int, 63",
        "%heap.aligned = and i64 %heap.up, -64",
        "%heap = inttoptr i64 %heap.aligned to ptr",
    ]
    return take, ["call void @free(ptr %heap.raw)"]


def text() -> str:
    """The module of what is shared."""
    files = ["handler", "no_threads"]
    if all(map(has_symbol, _WAITING)):
        files = ["handler", "threads", "affinity" if all(map(has_symbol, _AFFINITY)) else "no_affinity"]
    module = "\n".join(Path(__file__).with_name(f"{name}.ll").read_text() for name in files)
    return re.sub("<([A-Z_]+)>", lambda found: str(_NUMBERS[found[1]]), module)


def _said(sentence: str) -> str:
    return f'[{len(sentence) + 1} x i8] c"{sentence}\\00"'


_VERSION_AT = offset("Metadata", "api_version")
_CLOSED = 2**62
_NUMBERS = {
    "HANDLE": HANDLE, "SHARE": SHARE, "VECTORS": VECTORS, "CLOSED": _CLOSED, "LAST": _CLOSED + 1,
    "MAJOR": VERSION[0], "MINOR": VERSION[1],
    "FRAME": offset("CallFrame"), "EXTENSION": offset("CallFrame", "extension_start"), "API": offset("CallFrame", "api"),
    "CTX": offset("CallFrame", "ctx"), "STAGE": offset("CallFrame", "stage"),
    "ARGS": offset("CallFrame", "args") + offset("Args", "args"), "RETS": offset("CallFrame", "rets") + offset("Rets", "rets"),
    "TYPE": offset("Extension_Base", "type"), "METADATA": offset("Metadata_Extension", "metadata"),
    "METADATA_EXTENSION": offset("Metadata_Extension"), "METADATA_BYTES": offset("Metadata"),
    "VERSION": _VERSION_AT, "VERSION_BYTES": offset("Api_Version"), "TRAITS": offset("Metadata", "traits"),
    "VERSION_EXTENSION": _VERSION_AT + offset("Api_Version", "extension_start"),
    "VERSION_MAJOR": _VERSION_AT + offset("Api_Version", "major_version"),
    "VERSION_MINOR": _VERSION_AT + offset("Api_Version", "minor_version"),
    "CREATE": offset("Api", "XLA_FFI_Error_Create"), "CREATE_BYTES": offset("Error_Create_Args"),
    "MESSAGE": offset("Error_Create_Args", "message"), "CODE": offset("Error_Create_Args", "errc"),
    "DESTROY": offset("Api", "XLA_FFI_Error_Destroy"), "DESTROY_BYTES": offset("Error_Destroy_Args"),
    "ERROR": offset("Error_Destroy_Args", "error"),
    "SCHEDULE": offset("Api", "XLA_FFI_ThreadPool_Schedule"), "SCHEDULE_BYTES": offset("ThreadPool_Schedule_Args"),
    "SCHEDULE_CTX": offset("ThreadPool_Schedule_Args", "ctx"), "TASK": offset("ThreadPool_Schedule_Args", "task"),
    "DATA": offset("ThreadPool_Schedule_Args", "data"),
    "IS_METADATA": NUMBERS["XLA_FFI_Extension_Metadata"], "EXECUTE": NUMBERS["XLA_FFI_ExecutionStage_EXECUTE"],
    "INVALID": NUMBERS["XLA_FFI_Error_Code_INVALID_ARGUMENT"], "INTERNAL": NUMBERS["XLA_FFI_Error_Code_INTERNAL"],
    "EXHAUSTED": NUMBERS["XLA_FFI_Error_Code_RESOURCE_EXHAUSTED"],
    "SAYS_STAGE": _said("dae_jax: a compiled function was called in a wrong stage"),
    "SAYS_FRAME": _said("dae_jax: XLA's call frame is smaller than that of its interface"),
    "SAYS_MEMORY": _said("dae_jax: there is not enough memory for the arrays of a compiled function"),
    "SAYS_CODE": _said("dae_jax: the code of a compiled function could not be loaded"),
}  # fmt: skip
