"""Where the results of a sweep are kept while it runs: in memory, or in a folder that survives a kill.

A folder holds one array file for each leaf of the results, `done.npy` with a flag for each chunk, and `sweep.json`. The
flag of a chunk is written after its results have reached the disk.
"""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils


class Memory:
    """`arrays`: the results, by leaf; `done`: which chunks are there."""

    arrays: list[np.ndarray]
    done: np.ndarray

    def __init__(self, leaves: Sequence[jax.ShapeDtypeStruct], chunks: int) -> None:
        self.arrays = [np.zeros(x.shape, x.dtype) for x in leaves]
        self.done = np.zeros(chunks, bool)

    def put(self, chunk: int, start: int, rows: Sequence[np.ndarray]) -> None:
        """The results of one chunk, from the element `start` on."""
        for array, row in zip(self.arrays, rows, strict=True):
            array[start : start + len(row)] = row
        self.done[chunk] = True

    def collect(self, gather: Callable[[np.ndarray], np.ndarray] | None, chunk: int) -> list[np.ndarray]:
        """All results, those of other processes by `gather`, which stacks the arrays of all."""
        if gather is None:
            return self.arrays
        owner = np.repeat(np.argmax(gather(self.done), 0), chunk)
        return [gather(x)[owner[: len(x)], np.arange(len(x))] for x in self.arrays]


class Store(Memory):
    """The same in a folder."""

    arrays: list[np.memmap]
    done: np.memmap

    def __init__(self, arrays: list[np.memmap], done: np.memmap) -> None:
        self.arrays, self.done = list(arrays), done

    @classmethod
    def open(cls, folder: Path, leaves: Sequence[jax.ShapeDtypeStruct], chunks: int, fingerprint: str) -> "Store":
        """A new folder, or one of the same sweep.

        Errors: `ValueError` for the folder of another sweep; `OSError` where it cannot be written or there is no room.
        """
        shapes = [
            *((f"{i}.npy", x.shape, x.dtype) for i, x in enumerate(leaves)),
            ("done.npy", (chunks,), np.dtype(bool)),
        ]
        if jax.process_index() == 0:
            _create(folder, shapes, fingerprint)
        if jax.process_count() > 1:
            multihost_utils.sync_global_devices("dae_jax.sweep store")
        found = json.loads((folder / "sweep.json").read_text())
        if found["fingerprint"] != fingerprint:
            raise ValueError(
                f"`store` = {str(folder)!r} holds another sweep (of another function, other inputs, another chunk size or "
                "version of JAX). Choose another folder, or remove this one."
            )
        *arrays, done = (np.lib.format.open_memmap(folder / name, mode="r+") for name, _, _ in shapes)
        return cls(arrays, done)

    def put(self, chunk: int, start: int, rows: Sequence[np.ndarray]) -> None:
        for array, row in zip(self.arrays, rows, strict=True):
            array[start : start + len(row)] = row
            array.flush()
        self.done[chunk] = True
        self.done.flush()

    def collect(self, gather: Callable[[np.ndarray], np.ndarray] | None, chunk: int) -> list[np.ndarray]:
        if gather is not None:
            # What others wrote is in the same files once they are there.
            multihost_utils.sync_global_devices("dae_jax.sweep end")
        # Copied when written to: the results are the caller's, the files the sweep's.
        return [*(np.memmap(str(x.filename), x.dtype, "c", x.offset, x.shape) for x in self.arrays)]


def _create(folder: Path, shapes: list[tuple[str, Any, Any]], fingerprint: str) -> None:
    """Files of their final size, so that a disk without room is found before the work starts."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "sweep.json").exists():
            return
        if any(folder.iterdir()) and not (folder / "sweep.json.part").exists():
            raise FileExistsError(f"`store` = {str(folder)!r} is a folder with other files in it; choose a new one.")
        part = folder / "sweep.json.part"
        part.write_text(
            json.dumps({"fingerprint": fingerprint, "arrays": [[n, list(s), str(d)] for n, s, d in shapes]})
        )
        for name, shape, dtype in shapes:
            array = np.lib.format.open_memmap(folder / name, mode="w+", dtype=dtype, shape=shape)
            array.flush()
            with (folder / name).open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, max(os.fstat(file.fileno()).st_size, 1))
        # The description comes last: a folder without it was interrupted here.
        part.rename(folder / "sweep.json")
    except FileExistsError:
        raise
    except OSError as error:
        needed = sum(int(np.prod(s)) * np.dtype(d).itemsize for _, s, d in shapes)
        raise OSError(
            error.errno, f"`store` cannot be written ({error.strerror}); it needs {needed / 1e6:.3g} MB", str(folder)
        ) from None
