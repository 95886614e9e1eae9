"""Primitives that move entries about, on arrays of entries of any kind."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..types import Equation
from .gathers import gathered, scattered
from .objects import as_indices, objects


Entries = np.ndarray


def reshape(eqn: Equation, x: Entries) -> Entries:
    """Also `squeeze` and `expand_dims`."""
    return x.reshape(eqn.outvars[0].aval.shape)


def copy(_: object, x: Entries) -> Entries:
    """The same entries."""
    return x


def broadcast_in_dim(eqn: Equation, x: Entries) -> Entries:
    """Entries at several indices."""
    shape, inner = eqn.params["shape"], [1] * len(eqn.params["shape"])
    for size, dimension in zip(x.shape, eqn.params["broadcast_dimensions"], strict=True):
        inner[dimension] = size
    return np.broadcast_to(x.reshape(inner), shape)


def transpose(eqn: Equation, x: Entries) -> Entries:
    """Axes in another order."""
    return np.transpose(x, eqn.params["permutation"])


def tile(eqn: Equation, x: Entries) -> Entries:
    """The array repeated along its axes."""
    return np.tile(x, eqn.params["reps"])


def rev(eqn: Equation, x: Entries) -> Entries:
    """Axes from their end."""
    return np.flip(x, eqn.params["dimensions"])


def slice_(eqn: Equation, x: Entries) -> Entries:
    """A part of the array."""
    p = eqn.params
    strides = p["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]


def split(eqn: Equation, x: Entries) -> list[Entries]:
    """Pieces along an axis."""
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], axis=eqn.params["axis"])


def unstack(eqn: Equation, x: Entries) -> list[Entries]:
    """The entries along an axis."""
    entries = np.moveaxis(x, eqn.params["axis"], 0)
    return [entries[k, ...] for k in range(len(entries))]


def stack(eqn: Equation, *xs: Entries) -> Entries:
    """Arrays along a new axis."""
    return np.stack(xs, axis=eqn.params["axis"])


def concatenate(eqn: Equation, *xs: Entries) -> Entries:
    """Arrays one after another along an axis."""
    return np.concatenate(xs, axis=eqn.params["dimension"])


def iota(eqn: Equation) -> Entries:
    """Indices along an axis."""
    shape, dimension = eqn.params["shape"], eqn.params["dimension"]
    along = np.arange(shape[dimension]).astype(eqn.params["dtype"])
    return np.broadcast_to(
        objects(list(along), along.shape).reshape([-1 if i == dimension else 1 for i in range(len(shape))]), shape
    )


def pad(eqn: Equation, x: Entries, fill: Entries) -> Entries:
    """Something else around the entries and between them; of a negative width that many entries are left out."""
    config = eqn.params["padding_config"]
    around = [(max(low, 0), max(high, 0)) for low, high, _ in config]
    within = [n + max(n - 1, 0) * gap for n, (_, _, gap) in zip(x.shape, config, strict=True)]
    out = np.empty([low + n + high for n, (low, high) in zip(within, around, strict=True)], dtype=object)
    out[...] = fill[()]
    out[
        tuple(slice(low, low + n, gap + 1) for n, (low, _), (_, _, gap) in zip(within, around, config, strict=True))
    ] = x
    return out[
        tuple(slice(max(-low, 0), n - max(-high, 0)) for n, (low, high, _) in zip(out.shape, config, strict=True))
    ]


MOVEMENTS: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": broadcast_in_dim, "concatenate": concatenate, "copy": copy, "copy_p": copy, "expand_dims": reshape,
    "iota": iota, "pad": pad, "reshape": reshape, "rev": rev, "slice": slice_, "split": split, "squeeze": reshape,
    "stack": stack, "stop_gradient": copy, "tile": tile, "transpose": transpose, "unstack": unstack,
}  # fmt: skip


def windows_start(starts: Sequence[np.ndarray], shape: Sequence[int], sizes: Sequence[int]) -> list[int]:
    """Where a window with known starts begins: moved inside the array."""
    return [min(max(int(s[()]), 0), n - k) for s, n, k in zip(starts, shape, sizes, strict=True)]


def dynamic_slice(eqn: Equation, x: Entries, *starts: Entries) -> Entries:
    """A window at a known place."""
    sizes = eqn.params["slice_sizes"]
    return x[tuple(slice(s, s + k) for s, k in zip(windows_start(starts, x.shape, sizes), sizes, strict=True))]


def dynamic_update_slice(_: object, x: Entries, update: Entries, *starts: Entries) -> Entries:
    """The array with a window at a known place replaced."""
    out, first = x.copy(), windows_start(starts, x.shape, update.shape)
    out[tuple(slice(s, s + k) for s, k in zip(first, update.shape, strict=True))] = update
    return out


def gather(eqn: Equation, x: Entries, indices: Entries) -> Entries:
    """Entries at known places; what is outside of the array is the fill value."""
    p, dtype = eqn.params, np.dtype(eqn.outvars[0].aval.dtype)
    places = np.arange(x.size).reshape(x.shape)
    moved = gathered(places, as_indices(indices), p["dimension_numbers"], p["slice_sizes"], p["mode"])
    fill, flat = fill_of(p["fill_value"], dtype), x.ravel()
    return objects([flat[place] if place >= 0 else fill for place in moved.ravel()], moved.shape)


def fill_of(value: complex | None, dtype: np.dtype) -> Any:
    """What a gather gives outside of the array."""
    if value is None and dtype.kind in "iub":
        value = True if dtype.kind == "b" else np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return dtype.type(np.nan if value is None else value)


def scatter(eqn: Equation, x: Entries, indices: Entries, updates: Entries, combine: Callable[..., object]) -> Entries:
    """The array with `combine(before, update)` at known places; what is outside of the array is left out."""
    p, places = eqn.params, np.arange(x.size).reshape(x.shape)
    moved = scattered(places, as_indices(indices), updates.shape, p["dimension_numbers"], p["mode"])
    out = x.ravel().copy()
    for place, update in zip(moved.ravel(), updates.ravel(), strict=True):
        if place >= 0:
            out[place] = combine(out[place], update)
    return out.reshape(x.shape)
