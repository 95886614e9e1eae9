"""`sweep`: a function of one element over many, in chunks, on all cores and devices, resumable."""

import functools
import os
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Protocol

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from ..compiler import at_ease, processors, trace_state_clean
from ..driver.failures import sentence_of
from ..solution import RESULTS
from ..types import State
from ..validate.captured import current
from ..validate.states import brief
from ..validate.user_functions import at_numbers, refuse_untraceable
from .elements import OfKeys, is_key, leading, one_of
from .fingerprint import fingerprint
from .grid import Grid
from .progress import Progress
from .sweep_store import Memory, Store


# Lanes of one chunk and device. On a CPU lanes run a vector at a time, so that a chunk only has to outweigh the 0.1 ms of
# its start; on a GPU each is a thread, of which 100,000 and more run at a time; elsewhere they run in step.
LANES = {"cpu": 512, "gpu": 2**17}
LANES_OF_ACCELERATOR = 8192
# What goes in and comes out takes this part of a device's memory at most: several chunks are on their way at once.
PART_OF_MEMORY = 16


class Device(Protocol):
    """One of `jax.devices()`."""

    @property
    def platform(self) -> str: ...

    def memory_stats(self) -> Any: ...


@at_ease
@at_numbers
def sweep(
    fn: Callable[[Any], State],
    inputs: State | Grid,
    *,
    chunk_size: int | None = None,
    devices: Sequence[Device] | None = None,
    progress: bool = True,
    store: str | os.PathLike[str] | None = None,
) -> Any:
    """fn(element) for every element along the leading axis of `inputs`.

    **Arguments**

    - `fn`: any JAX function of one element to a pytree of arrays, usually a `daesolve(..., throw=False)` and what is to
      be kept of it: a final state, a maximum of the drift, an energy error. What it returns is all that is kept.
    - `inputs`: a pytree of arrays, also of `jax.random.split(key)`, with a common leading axis, or a `grid`.
    - `chunk_size`: elements of one compiled call; by default 512 for each CPU device, on each GPU 131,072, or as many as a
      sixteenth of its memory holds the inputs and results of, and 8192 for each other accelerator.
    - `devices`: by default all of this process. On one CPU device several chunks run at once, one for each core.
    - `progress`: a bar on stderr, with the rate, the time left, and how many solves failed; at the end, why.
    - `store`: a folder. Results are written there as they come; the same sweep with the same folder goes on where it was
      interrupted, also by a kill, and ends with the same bits. The result's arrays are then files mapped into memory, in
      which what one writes into them does not end up. What `fn` calls in Python is recognised by its code.

    Under `jax.distributed.initialize` every process computes its share and all return the whole; `store` must then be a
    folder that all see.

    **Returns** the results as numpy arrays with a leading axis of elements, or of the grid's shape. A solve that fails
    does not stop the others: return `sol.result` from `fn`, and it becomes an array of codes to compare, as in
    `out.result == dae_jax.RESULTS.successful`.

    Errors: `ValueError` for inputs without a common leading axis, and for a store of another sweep; `OSError` before the
    work starts where the store cannot be written or there is no room for it.
    """
    if not callable(fn):
        raise TypeError(f"`fn` must be a function of one element, but is {brief(fn)}.")
    fn, elements = current(fn), inputs.elements() if isinstance(inputs, Grid) else inputs
    if any(map(is_key, jax.tree.leaves(elements))):
        fn, elements = OfKeys.of(fn, elements)
    elements = jax.tree.map(np.asarray, elements)
    size = leading(elements)
    devices = list(devices or jax.local_devices())
    if chunk_size is not None and (not isinstance(chunk_size, int | np.integer) or chunk_size < 1):
        raise ValueError(f"`chunk_size` must be an integer, at least 1, but is {chunk_size!r}.")
    with refuse_untraceable("fn"):
        if not trace_state_clean():
            _refuse_traced(jax.make_jaxpr(fn)(one_of(elements)).consts)
        lanes = _lanes(fn, elements, devices[0]) if chunk_size is None else -(-int(chunk_size) // len(devices))
        chunk = min(lanes, -(-size // len(devices))) * len(devices)
        call, out = _compiled(fn, elements, chunk, devices)
    leaves, structure = jax.tree.flatten(out)
    if any(jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) for x in leaves):
        raise TypeError("`fn` must return arrays of numbers, but returns keys: return `jax.random.key_data(key)`.")
    leaves = [jax.ShapeDtypeStruct((size, *x.shape[1:]), x.dtype) for x in leaves]
    chunks = -(-size // chunk)
    kept = (
        Memory(leaves, chunks)
        if store is None
        else Store.open(Path(store), leaves, chunks, fingerprint(fn, one_of(elements), elements, chunk))
    )
    failures = _failures(structure)
    progress = progress and jax.process_index() == 0
    with Progress("sweep", size, progress, chunk * int(np.sum(kept.done))) as shown:
        _run(call, elements, chunk, kept, devices, lambda: shown.show(*_state(kept, chunk, size, failures)))
    arrays = kept.collect(_gathered if jax.process_count() > 1 else None, chunk)
    for code, count in failures(arrays).most_common() if progress else ():
        print(f"  {count:,} × {_message(code)}", file=sys.stderr)
    if isinstance(inputs, Grid):
        arrays = [x.reshape(*inputs.shape, *x.shape[1:]) for x in arrays]
    return jax.tree.unflatten(structure, arrays)


def _lanes(fn: Callable[..., PyTree], elements: PyTree, device: Device) -> int:
    """How many elements a device gets at a time."""
    most = LANES.get(device.platform, LANES_OF_ACCELERATOR)
    memory = (device.memory_stats() or {}).get("bytes_limit")
    if memory is None:
        return most
    one = one_of(elements)
    bytes_of = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves((one, jax.eval_shape(fn, one))))
    held = memory // PART_OF_MEMORY // max(bytes_of, 1)
    # A power of two: what was stored goes on where a little more or less memory is free.
    return min(most, 2 ** max(held.bit_length() - 1, 0))


def _refuse_traced(closed_over: Sequence[Any]) -> None:
    if any(isinstance(x, Tracer) for x in closed_over):
        raise ValueError(
            "`fn` must not close over what `jit`, `vmap` or `grad` traces: `sweep` computes numbers. Call it outside of them, or take "
            "`jax.vmap(fn)` within."
        )


def _compiled(fn: Callable[..., PyTree], elements: PyTree, chunk: int, devices: list[Device]) -> tuple[Any, Any]:
    """The compiled function of one chunk, and the shapes of its results."""
    # A module with arrays in it has no hash: it is compiled each time.
    batched, placed = _batched(fn if _has_hash(fn) else functools.partial(fn), tuple(devices))
    shape = lambda x: jax.ShapeDtypeStruct(
        (chunk, *x.shape[1:]), jax.dtypes.canonicalize_dtype(x.dtype), sharding=placed
    )
    lowered = batched.lower(jax.tree.map(shape, elements))
    compiled = lowered.compile()
    return lambda part: compiled(jax.device_put(part, placed)), lowered.out_info


def _has_hash(fn: object) -> bool:
    try:
        hash(fn)
    except TypeError:
        return False
    return True


@functools.lru_cache(maxsize=16)
def _batched(fn: Callable[..., PyTree], devices: tuple[Device, ...]) -> tuple[Any, NamedSharding]:
    """`fn` over a chunk that is spread over the devices. Remembered, so that the same sweep compiles once."""
    spec = PartitionSpec("lanes")
    mesh = Mesh(np.array(devices), ("lanes",))
    batched = jax.vmap(fn)
    if len(devices) > 1:
        batched = jax.shard_map(batched, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(batched), NamedSharding(mesh, spec)


def _run(
    call: Callable[..., PyTree],
    elements: PyTree,
    chunk: int,
    kept: PyTree,
    devices: list[Device],
    report: Callable[[], None],
) -> None:
    """All chunks of this process that are not done, several at once: what is no kernel of ours may take one core only."""
    size = jax.tree.leaves(elements)[0].shape[0]
    mine = [c for c in np.flatnonzero(~kept.done) if c % jax.process_count() == jax.process_index()]
    workers = max(processors() // len(devices), 1) if devices[0].platform == "cpu" else 2
    # A context, `with jax.enable_x64(True)`, is that of its thread.
    precise = jax.dtypes.canonicalize_dtype(float) == np.float64

    def work(c: int) -> tuple[int, list[np.ndarray]]:
        # The last chunk is filled with its last element, so that one compiled function serves all.
        at = np.minimum(np.arange(c * chunk, (c + 1) * chunk), size - 1)
        with jax.enable_x64(precise):
            out = call(jax.tree.map(lambda x: x[at], elements))
        count = min(chunk, size - c * chunk)
        return c, [np.asarray(x)[:count] for x in jax.tree.leaves(out)]

    with ThreadPoolExecutor(workers) as pool:
        waiting: set[Future[Any]] = set()
        todo = iter(mine)
        try:
            while True:
                while len(waiting) < 2 * workers and (c := next(todo, None)) is not None:
                    waiting.add(pool.submit(work, int(c)))
                if not waiting:
                    return
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in finished:
                    c, rows = _result(future)
                    kept.put(c, c * chunk, rows)
                report()
        finally:
            for future in waiting:
                future.cancel()


def _result(future: Future[Any]) -> Any:
    try:
        return future.result()
    except jax.errors.JaxRuntimeError as error:
        sentence = sentence_of(error)
        if sentence is None:
            raise
        raise RuntimeError(
            f"{sentence}\nIn a sweep call `daesolve(..., throw=False)` and return `sol.result`: an element that fails does not "
            "stop the others then."
        ) from None


def _failures(structure: Any) -> Callable[[list[np.ndarray]], Counter[int]]:
    """How many elements have which result that is not a success, where the function returns results."""
    numbered = jax.tree.unflatten(structure, range(structure.num_leaves))
    is_result = lambda x: isinstance(x, type(RESULTS.successful))
    places = [x._value for x in jax.tree.leaves(numbered, is_leaf=is_result) if is_result(x)]
    okay = [int(code._value) for code in (RESULTS.successful, RESULTS.event_occurred)]

    def count(arrays: list[np.ndarray]) -> Counter[int]:
        if not places:
            return Counter()
        codes = np.concatenate([arrays[place].reshape(len(arrays[place]), -1) for place in places], axis=1)
        failed = ~np.isin(codes, okay)
        first = np.take_along_axis(codes, np.argmax(failed, 1)[:, None], 1)[failed.any(1)]
        return Counter(dict(zip(*(x.tolist() for x in np.unique(first, return_counts=True)), strict=True)))

    return count


def _message(code: int) -> str:
    return RESULTS[eqx.tree_at(lambda result: result._value, RESULTS.successful, np.asarray(code))]


def _state(
    kept: PyTree, chunk: int, size: int, failures: Callable[[list[np.ndarray]], Counter[int]]
) -> tuple[int, str]:
    done = np.repeat(kept.done, chunk)[:size]
    failed = failures([x[done] for x in kept.arrays]).total()
    return int(done.sum()), f"{failed:,} failed" if failed else ""


def _gathered(x: np.ndarray) -> np.ndarray:
    """The array of every process, one below the other."""
    return np.asarray(multihost_utils.process_allgather(x))
