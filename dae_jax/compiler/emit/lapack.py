"""LAPACK and BLAS for machine code: the ones that SciPy has, which JAX calls too."""

import ctypes
import functools
import importlib

from .target import llvm


@functools.cache
def symbol(name: str) -> str | None:
    """The symbol by which machine code calls a function, such as `dgetrf`, that takes addresses of its arguments and 32-bit integers;
    `None` where SciPy has none such.
    """
    modules = map(importlib.import_module, ("scipy.linalg.cython_blas", "scipy.linalg.cython_lapack"))
    capsule = next((module.__pyx_capi__[name] for module in modules if name in module.__pyx_capi__), None)
    if capsule is None:
        return None
    python = ctypes.pythonapi
    python.PyCapsule_GetName.restype, python.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    python.PyCapsule_GetPointer.restype = ctypes.c_void_p
    python.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    signature = python.PyCapsule_GetName(capsule)
    if b"int *" not in signature:
        return None
    llvm().add_symbol(f"dae_jax_{name}", python.PyCapsule_GetPointer(capsule, signature))
    return f"dae_jax_{name}"
