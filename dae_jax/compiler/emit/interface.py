"""XLA's interface for foreign functions (xla/ffi/api/c_api.h), version 0.3, where pointers have 64 bits.

XLA calls a handler with a call frame, in which the buffers of the arguments and the results are, and gets an error back (null:
none). A call with an extension of type 1 asks for the version of the interface: the answer is the one that the offsets below
belong to. XLA refuses a handler of a version that it does not serve.
"""

# major, minor
VERSION = (0, 3)

# Where the fields are, in bytes; "" is the size up to the end of the last field that the header counts.
OFFSETS = {
    "XLA_FFI_CallFrame": {
        "struct_size": 0, "extension_start": 8, "api": 16, "ctx": 24, "stage": 32, "args": 40, "rets": 80, "attrs": 120, "": 168,
    },
    "XLA_FFI_Args": {"size": 16, "args": 32, "": 40},
    "XLA_FFI_Rets": {"size": 16, "rets": 32, "": 40},
    "XLA_FFI_Buffer": {"data": 24, "dims": 40, "": 48},
    "XLA_FFI_Extension_Base": {"struct_size": 0, "type": 8, "": 24},
    "XLA_FFI_Metadata_Extension": {"extension_base": 0, "metadata": 24, "": 32},
    "XLA_FFI_Metadata": {"struct_size": 0, "api_version": 8, "traits": 32, "": 36},
    "XLA_FFI_Api_Version": {"struct_size": 0, "extension_start": 8, "major_version": 16, "minor_version": 20, "": 24},
    "XLA_FFI_Api": {
        "XLA_FFI_Error_Create": 48, "XLA_FFI_Error_Destroy": 64, "XLA_FFI_Stream_Get": 80, "XLA_FFI_ThreadPool_Schedule": 136,
    },
    "XLA_FFI_Stream_Get_Args": {"struct_size": 0, "extension_start": 8, "ctx": 16, "stream": 24, "": 32},
    "XLA_FFI_Error_Create_Args": {"struct_size": 0, "extension_start": 8, "message": 16, "errc": 24, "": 28},
    "XLA_FFI_Error_Destroy_Args": {"struct_size": 0, "extension_start": 8, "error": 16, "": 24},
    "XLA_FFI_ThreadPool_Schedule_Args": {
        "struct_size": 0, "extension_start": 8, "ctx": 16, "task": 24, "data": 32, "": 40,
    },
}  # fmt: skip
NUMBERS = {
    "XLA_FFI_Extension_Metadata": 1,
    "XLA_FFI_ExecutionStage_EXECUTE": 3,
    "XLA_FFI_Error_Code_INVALID_ARGUMENT": 3,
    "XLA_FFI_Error_Code_RESOURCE_EXHAUSTED": 8,
    "XLA_FFI_Error_Code_INTERNAL": 13,
}


def offset(struct: str, field: str = "") -> int:
    """Where a field of one of the interface's structures is; without a field, the structure's size."""
    return OFFSETS[f"XLA_FFI_{struct}"][field]


def buffer(array: str, k: int, name: str) -> list[str]:
    """The instructions that find the numbers of the k-th buffer of an array of buffers."""
    return [
        f"%{name}.at = getelementptr ptr, ptr {array}, i64 {k}",
        f"%{name}.buffer = load ptr, ptr %{name}.at",
        f"%{name}.data = getelementptr i8, ptr %{name}.buffer, i64 {offset('Buffer', 'data')}",
        f"%{name} = load ptr, ptr %{name}.data",
    ]


def batch_size(name: str) -> list[str]:
    """The instructions that find %batch, the first dimension of the buffer that `buffer` found by this name."""
    return [
        f"%dims.at = getelementptr i8, ptr %{name}.buffer, i64 {offset('Buffer', 'dims')}",
        "%dims = load ptr, ptr %dims.at",
        "%batch = load i64, ptr %dims",
    ]
