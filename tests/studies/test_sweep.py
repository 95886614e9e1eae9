"""`sweep` equals one at a time, in any number of pieces, processes and lives."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import types

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import dae_jax
from dae_jax import reductions
from dae_jax.scenes import SCENES
from dae_jax.studies import sweep as sweep_file
from dae_jax.studies.fingerprint import fingerprint


PENDULUM = SCENES["pendulum"]()
DOUBLE = SCENES["double-pendulum"]()
PROJECTED = dae_jax.OrthogonalProjection(dae_jax.DOP853())


def swing(angle):
    y0 = (jnp.stack([jnp.sin(angle), jnp.cos(angle)]), jnp.zeros(2))
    sol = dae_jax.daesolve(PENDULUM.system, PROJECTED, 0.0, 1.0, None, y0, throw=False)
    return {"q": sol.ys[0][-1], "drift": reductions.largest_drift(PENDULUM.system, sol)}


@pytest.mark.parametrize("chunk_size", [None, 4, 7])
def test_equals_one_at_a_time(chunk_size):
    angles = np.linspace(0.1, 3.0, 23)
    found = dae_jax.sweep(swing, angles, chunk_size=chunk_size, progress=False)
    assert found["q"].shape == (23, 2)
    one = jax.jit(swing)
    for angle, q in zip(angles, found["q"], strict=True):
        np.testing.assert_allclose(q, one(angle)["q"], rtol=1e-12, atol=1e-13)
    assert found["drift"].max() < 1e-14


def test_whole_solutions_are_a_batch_of_them(tmp_path):
    """They hold arrays of numpy, which the diagnostics took for a solution without saved states."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, g: jnp.stack([0.0, g]), PENDULUM.system.constraint, potential=lambda q, g: -g * q[1]
    )

    def solved(g):
        return dae_jax.daesolve(system, PROJECTED, 0.0, 1.0, None, PENDULUM.y0, g, saveat=diffrax.SaveAt(ts=np.ones(2)))

    gravities = np.array([1.0, 9.81, 25.0])
    batch = jax.vmap(solved)(gravities)
    for store in (None, tmp_path / "store"):
        swept = dae_jax.sweep(solved, gravities, progress=False, store=store)
        for diagnostic in (dae_jax.drift, dae_jax.energy, dae_jax.multipliers):
            pairs = zip(*(jax.tree.leaves(diagnostic(system, sol)) for sol in (swept, batch)), strict=True)
            for a, b in pairs:
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_two_devices_give_the_same():
    angles = np.linspace(0.1, 3.0, 23)
    one = dae_jax.sweep(swing, angles, chunk_size=6, devices=jax.devices()[:1], progress=False)
    both = dae_jax.sweep(swing, angles, chunk_size=6, devices=jax.devices(), progress=False)
    assert len(jax.devices()) == 2
    np.testing.assert_allclose(one["q"], both["q"], rtol=1e-13)


def test_grid_has_named_axes():
    found = dae_jax.sweep(
        lambda p: p["a"] * 10 + p["b"], dae_jax.grid(a=[1.0, 2.0, 3.0], b=np.arange(4.0)), progress=False
    )
    np.testing.assert_array_equal(found, np.array([1.0, 2.0, 3.0])[:, None] * 10 + np.arange(4.0))


def test_a_solve_that_fails_is_marked_and_the_rest_goes_on(capsys):
    def fall(limit):
        force = lambda t, q, v, args: jnp.where(t > args, jnp.nan, jnp.array([0.0, 9.81]))
        system = dae_jax.ConstrainedSystem(force, PENDULUM.system.constraint)
        sol = dae_jax.daesolve(system, PROJECTED, 0.0, 1.0, None, PENDULUM.y0, limit, throw=False)
        return sol.ys[0][-1], sol.result

    q, result = dae_jax.sweep(fall, np.array([2.0, 0.5, 3.0]))
    np.testing.assert_array_equal(result == dae_jax.RESULTS.successful, [True, False, True])
    np.testing.assert_array_equal(q[0], q[2])
    assert "1 failed" in capsys.readouterr().err


@pytest.mark.parametrize(
    "inputs",
    [np.float64(1.0), {"a": np.ones(3), "b": np.ones(4)}, np.ones((0, 2)), ()],
    ids=["scalar", "uneven", "empty", "none"],
)
def test_inputs_without_a_leading_axis_are_refused(inputs):
    with pytest.raises(ValueError, match="common leading axis"):
        dae_jax.sweep(lambda x: x, inputs)


def test_wrong_grids_and_chunks_are_refused():
    with pytest.raises(ValueError, match="at least one axis"):
        dae_jax.grid()
    with pytest.raises(ValueError, match="`a` must be a sequence"):
        dae_jax.grid(a=1.0)
    with pytest.raises(ValueError, match="`chunk_size`"):
        dae_jax.sweep(lambda x: x, np.ones(3), chunk_size=0)


# The store


def test_a_store_is_taken_up_again_and_refuses_another_sweep(tmp_path):
    angles = np.linspace(0.1, 3.0, 23)
    first = dae_jax.sweep(swing, angles, chunk_size=5, store=tmp_path / "s", progress=False)
    done = np.load(tmp_path / "s" / "done.npy")
    assert done.all()
    again = dae_jax.sweep(swing, angles, chunk_size=5, store=tmp_path / "s", progress=False)
    np.testing.assert_array_equal(first["q"], again["q"])
    for other in (lambda: dae_jax.sweep(swing, angles + 1, chunk_size=5, store=tmp_path / "s", progress=False),
                  lambda: dae_jax.sweep(lambda a: a, angles, chunk_size=5, store=tmp_path / "s", progress=False)):  # fmt: skip
        with pytest.raises(ValueError, match="holds another sweep"):
            other()


@pytest.mark.parametrize("of", [lambda f: f, jax.jit, lambda f: lambda x: jax.lax.map(jax.jit(f), x[None])[0]])
def test_functions_that_differ_in_a_constant_alone_are_other_sweeps(tmp_path, of):
    one, close = np.array([0.1234567890123, 1.0, 2.0]), np.array([0.1234567891, 1.0, 2.0])
    sweep = lambda c: dae_jax.sweep(of(lambda x: x * c), np.ones(4), store=tmp_path / "s", progress=False)
    np.testing.assert_array_equal(sweep(one), np.tile(one, (4, 1)))
    for c in (close, close[0], float(close[0]), one[0]):
        with pytest.raises(ValueError, match="holds another sweep"):
            sweep(c)


@pytest.mark.parametrize("factor", [2.0, np.array([2.0])], ids=["constant", "closed over"])
def test_what_python_computes_counts(tmp_path, factor):
    def of(factor):
        by = (lambda x: np.asarray(x * factor)) if isinstance(factor, np.ndarray) else eval(f"lambda x: x * {factor}")
        of_one = lambda x: jax.pure_callback(by, jax.ShapeDtypeStruct((1,), float), x[None], vmap_method="expand_dims")
        return dae_jax.sweep(of_one, np.arange(4.0), store=tmp_path / "s", progress=False)

    first = of(factor)
    np.testing.assert_array_equal(of(factor), first)
    with pytest.raises(ValueError, match="holds another sweep"):
        of(factor + 1)


class Scaled:
    def __init__(self, factor):
        self.factor = factor

    def by(self, x):
        return np.asarray(x * self.factor * len({"a", "b"}))

    def half(self, x):
        return np.asarray(x / len({"a", "b"}))


class Slotted:
    __slots__ = ("factor",)

    def __init__(self, factor):
        self.factor = factor

    def by(self, x):
        return np.asarray(x * self.factor)


FACTOR = 1.0


def by_a_global(x):
    return np.asarray(FACTOR * x)


def test_a_global_that_a_callback_reads_counts(monkeypatch, tmp_path):
    call = lambda x: jax.pure_callback(by_a_global, jax.ShapeDtypeStruct((), float), x, vmap_method="sequential")
    run = lambda: dae_jax.sweep(call, np.ones(3), store=tmp_path / "s", progress=False)
    np.testing.assert_array_equal(run(), 1)
    np.testing.assert_array_equal(run(), 1)
    monkeypatch.setitem(globals(), "FACTOR", 2.0)
    with pytest.raises(ValueError, match="holds another sweep"):
        run()


def test_what_helpers_and_methods_compute_counts():
    """However deep they are closed over; and always with the same fingerprint."""

    def of(host):
        call = lambda x: jax.pure_callback(host, jax.ShapeDtypeStruct((), float), x)
        return fingerprint(call, jax.ShapeDtypeStruct((), float), np.arange(3.0), 2)

    def through(last):
        def inner(x):
            return [x, 2 * x][0]

        def outer(x):
            return last(inner(x))

        return outer

    hosts = [through(lambda x, n=n: x + n) for n in (1, 2)] + [through(lambda x: x - 1)]
    hosts += [Scaled(2).by, Scaled(3).by, Scaled(2).half, Slotted(2).by, Slotted(3).by]
    x = np.linspace(0, 5, 9)
    hosts += [CubicSpline(x, np.sin(x)).__call__, CubicSpline(x, np.cos(x)).__call__]
    found = [of(host) for host in hosts]
    assert len(set(found)) == len(hosts)
    assert [of(host) for host in hosts] == found


def test_what_is_written_into_the_results_stays_out_of_the_store(tmp_path):
    run = lambda: dae_jax.sweep(lambda x: x, np.ones(3), store=tmp_path / "s", progress=False)
    run()[:] = 7
    np.testing.assert_array_equal(run(), 1)


# Keys


def test_keys_are_elements(tmp_path):
    keys, draw = jax.random.split(jax.random.key(0), 6), lambda key: jax.random.normal(key, (2,))
    wanted = jax.vmap(draw)(keys)
    for store in (None, tmp_path / "s"):
        np.testing.assert_array_equal(dae_jax.sweep(draw, keys, chunk_size=4, store=store, progress=False), wanted)
    inputs = {"k": keys, "x": np.arange(6.0)}
    found = dae_jax.sweep(lambda e: e["x"] * draw(e["k"]), inputs, progress=False)
    np.testing.assert_array_equal(found, inputs["x"][:, None] * wanted)


@pytest.mark.parametrize("inputs", [np.array(["a", "b"]), np.array([None, 1])], ids=["strings", "objects"])
def test_inputs_that_are_no_numbers_are_refused(inputs):
    with pytest.raises(TypeError, match="must be arrays of numbers"):
        dae_jax.sweep(lambda x: x, inputs)


def test_a_chunk_is_a_whole_number():
    for wrong in (2.5, "2", np.nan, np.inf, 0):
        with pytest.raises(ValueError, match="must be an integer"):
            dae_jax.sweep(lambda x: x, np.ones(3), chunk_size=wrong)


def test_what_is_traced_is_refused():
    """It was an error of numpy, or "Computation compiled for 2 inputs but called with 1"."""
    of = lambda x: dae_jax.sweep(lambda k: k, x * np.ones(3), progress=False)
    closing_over = lambda x: dae_jax.sweep(lambda k: k * x, np.ones(3), progress=False)
    for transformed in (jax.jit, jax.vmap, lambda fn: lambda x: dae_jax.sweep(fn, x, progress=False)):
        with pytest.raises(ValueError, match="`sweep` looks at numbers"):
            transformed(of)(jnp.ones(1))
        with pytest.raises(ValueError, match="`fn` must not close over"):
            transformed(closing_over)(jnp.ones(1))
    known = jax.jit(lambda x: x * dae_jax.sweep(lambda k: 2 * k, np.ones(3), progress=False))
    np.testing.assert_array_equal(known(3.0), 6 * np.ones(3))


def test_a_module_with_arrays_is_a_function(tmp_path):
    class Scaled(eqx.Module):
        factor: jax.Array

        def __call__(self, x):
            return self.factor * x

    for factor in (2.0, 3.0):
        found = dae_jax.sweep(Scaled(jnp.full(2, factor)), np.arange(3.0), progress=False)
        np.testing.assert_array_equal(found, factor * np.arange(3.0)[:, None] * np.ones(2))
    dae_jax.sweep(Scaled(jnp.ones(2)), np.ones(3), progress=False, store=tmp_path / "store")
    with pytest.raises(ValueError, match="holds another sweep"):
        dae_jax.sweep(Scaled(jnp.zeros(2)), np.ones(3), progress=False, store=tmp_path / "store")


def test_whole_numbers_that_do_not_fit_are_refused():
    """2⁴⁰ was 0 without 64 bits. In a context of the thread, which others that work have not."""
    with jax.enable_x64(False):
        assert dae_jax.sweep(lambda x: x, np.array([2**30]), progress=False) == 2**30
        with pytest.raises(ValueError, match="hold whole numbers that int32 does not"):
            dae_jax.sweep(lambda x: x, np.array([2**40]), progress=False)


def test_keys_are_no_results():
    with pytest.raises(TypeError, match="must return arrays of numbers, but returns keys"):
        dae_jax.sweep(lambda key: jax.random.split(key), jax.random.split(jax.random.key(0), 3), progress=False)


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OSError, match="other files in it"):
        dae_jax.sweep(lambda x: x, np.ones(3), store=tmp_path, progress=False)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_a_path_that_cannot_be_written_is_an_error_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="cannot be written"):
        dae_jax.sweep(lambda x: x, np.ones(3), store=tmp_path / "file" / "store", progress=False)


def test_a_disk_without_room_is_an_error_before_the_work(tmp_path):
    huge = lambda x: jnp.broadcast_to(x, (1 << 20, 1 << 12))
    with pytest.raises(OSError, match=r"cannot be written .*it needs .* MB"):
        # 4 GB an element, 10⁶ elements: more than any disk.
        dae_jax.sweep(huge, np.ones(1_000_000), chunk_size=1, store=tmp_path / "s", progress=False)


SLOW = """
import sys, time
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np
import dae_jax

def fn(x):
    # Long enough that a kill comes in between.
    return jax.lax.fori_loop(0, 400_000, lambda i, s: jnp.sin(s) + x, x)

out = dae_jax.sweep(fn, np.linspace(0, 1, 400), chunk_size=10, progress=False, store=sys.argv[1])
np.save(sys.argv[2], out)
"""


def test_a_killed_sweep_goes_on_and_ends_with_the_same_bits(tmp_path):
    run = lambda store: subprocess.Popen(
        [sys.executable, "-c", SLOW, str(tmp_path / store), str(tmp_path / f"{store}.npy")]
    )
    process = run("killed")
    flags, deadline = tmp_path / "killed" / "done.npy", time.monotonic() + 60
    while not ((tmp_path / "killed" / "sweep.json").exists() and np.load(flags).sum() >= 3):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = np.load(flags)
    assert 0 < done.sum() < done.size
    assert run("killed").wait() == 0
    assert run("whole").wait() == 0
    assert np.load(flags).all()
    np.testing.assert_array_equal(np.load(tmp_path / "killed.npy"), np.load(tmp_path / "whole.npy"))


TWO = """
import json, sys
import jax
jax.config.update("jax_enable_x64", True)
address, index, store, out = sys.argv[1:]
if index != "alone":
    jax.distributed.initialize(coordinator_address=address, num_processes=2, process_id=int(index))
import jax.numpy as jnp, numpy as np
import dae_jax
result = dae_jax.sweep(lambda p: jnp.sin(p["a"]) * p["b"], dae_jax.grid(a=np.linspace(0, 1, 9), b=np.linspace(0, 1, 7)),
                       chunk_size=5, progress=False, store=store or None)
np.save(out, result)
"""


@pytest.mark.parametrize("with_store", [False, True], ids=["memory", "store"])
def test_two_processes_give_the_same_as_one(tmp_path, with_store):
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        address = f"localhost:{probe.getsockname()[1]}"
    names = {"0": "both", "1": "both", "alone": "alone"}
    start = lambda index: subprocess.Popen(
        [sys.executable, "-c", TWO, address, index, str(tmp_path / names[index]) if with_store else "", str(tmp_path / f"{index}.npy")],
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    processes = [start("0"), start("1"), start("alone")]
    assert [p.wait(timeout=120) for p in processes] == [0, 0, 0]
    first, second, alone = (np.load(tmp_path / f"{index}.npy") for index in names)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, alone)
    if with_store:
        assert json.loads((tmp_path / "both" / "sweep.json").read_text())["arrays"][0][1] == [63]


# What is kept


def test_reductions():
    times = np.linspace(0, 2, 41)
    sol = dae_jax.daesolve(PENDULUM.system, PROJECTED, 0.0, 2.0, None, PENDULUM.y0, saveat=diffrax.SaveAt(ts=times))
    exact = PENDULUM.reference(times)
    assert reductions.largest_error(sol, exact) == max(
        float(np.abs(a - b).max()) for a, b in zip(sol.ys, exact, strict=True)
    )
    assert 0 < reductions.largest_error(sol, exact) < 1e-6
    assert reductions.energy_error(PENDULUM.system, sol) < 1e-6
    assert reductions.largest_drift(PENDULUM.system, sol) < 1e-14
    np.testing.assert_array_equal(reductions.final_state(sol)[0], sol.ys[0][-1])


def test_the_error_of_the_energy_at_one_time_alone_is_refused():
    """It was 0 in every lane of a sweep that saves the end only, as a solve does by default."""
    sol = dae_jax.daesolve(PENDULUM.system, diffrax.Tsit5(), 0.0, 2.0, 0.1, PENDULUM.y0)
    with pytest.raises(
        ValueError, match="`energy_error` compares the saved times with the first of them, and there is one"
    ):
        reductions.energy_error(PENDULUM.system, sol)


@pytest.mark.parametrize("of", [lambda q, v: (q[0], v[0]), lambda q, v: (q[:, 0], v[:, 0]), lambda q, v: q])
def test_a_reference_of_other_shapes_is_refused(of):
    """Two times of a pendulum, of two coordinates, were compared with numbers along the wrong axis."""
    sol = dae_jax.daesolve(
        PENDULUM.system, PROJECTED, 0.0, 2.0, None, PENDULUM.y0, saveat=diffrax.SaveAt(t0=True, t1=True)
    )
    with pytest.raises(ValueError, match="must have the structure and the shapes of"):
        reductions.largest_error(sol, of(*sol.ys))


@pytest.mark.parametrize("sign", [1, -1])
def test_the_first_time_is_that_in_the_order_of_the_solve(sign):
    ts = sign * jnp.array([0.0, 1.0, 2.0, jnp.inf])
    assert reductions.first_time(ts, jnp.array([False, True, True, False])) == sign
    assert reductions.first_time(ts, jnp.zeros(4, bool)) == np.inf


def test_first_flip_of_a_pendulum_that_turns_over():
    scene = dae_jax.scenes.pendulum(angle=0.0, angular_velocity=7.0)
    times = np.linspace(0, 2, 2001)
    q, _ = scene.reference(times)
    top = times[np.argmax(np.diff(np.sign(q[:, 0])) < 0) + 1]
    sol = dae_jax.daesolve(scene.system, PROJECTED, 0.0, 2.0, None, scene.y0, saveat=diffrax.SaveAt(ts=times))
    np.testing.assert_allclose(reductions.first_flip(sol.ts, sol.ys[0]), top, atol=2e-3)
    swings = dae_jax.daesolve(PENDULUM.system, PROJECTED, 0.0, 2.0, None, PENDULUM.y0, saveat=diffrax.SaveAt(ts=times))
    assert reductions.first_flip(swings.ts, swings.ys[0]) == np.inf


def test_lyapunov_exponent_is_the_growth_of_a_small_difference_in_minimal_coordinates():
    """Of the double pendulum, by the reference that does not use the library, moved by a small angle."""
    t1, small = 6.0, 1e-6
    plus, minus = (dae_jax.scenes.double_pendulum(np.pi / 2 + s, np.pi / 2 + s) for s in (small, -small))
    grown = [
        (a[0] - b[0]) / (2 * small)
        for a, b in zip(plus.reference(np.array([t1])), minus.reference(np.array([t1])), strict=True)
    ]
    start = [(a - b) / (2 * small) for a, b in zip(plus.y0, minus.y0, strict=True)]
    norm = lambda parts: np.sqrt(sum(np.sum(np.asarray(x) ** 2) for x in parts))
    controller = diffrax.PIDController(rtol=1e-10, atol=1e-10)

    def end(s):
        y0 = jax.tree.map(lambda y, d: y + s * d, jax.tree.map(jnp.asarray, DOUBLE.y0), tuple(map(jnp.asarray, start)))
        y0 = dae_jax.consistent_state(DOUBLE.system, 0.0, y0)
        sol = dae_jax.daesolve(
            DOUBLE.system, PROJECTED, 0.0, t1, None, y0, adjoint=diffrax.ForwardMode(), stepsize_controller=controller
        )
        return reductions.final_state(sol)

    _, tangent = jax.jvp(end, (0.0,), (1.0,))
    np.testing.assert_allclose(np.concatenate(tangent), np.concatenate(grown), rtol=1e-4, atol=1e-4 * norm(grown))
    exponent = reductions.lyapunov(
        DOUBLE.system,
        PROJECTED,
        0.0,
        t1,
        jax.tree.map(jnp.asarray, DOUBLE.y0),
        direction=tuple(map(jnp.asarray, start)),
        stepsize_controller=controller,
    )
    np.testing.assert_allclose(exponent, np.log(norm(grown) / norm(start)) / t1, rtol=1e-4)


FAILS = {"max_steps": 5, "throw": False}


class TestOfASolveThatEndsEarly:
    """Numbers of the whole time are no numbers of a part of it."""

    def test_an_exponent_is_nan(self):
        args = PENDULUM.system, PROJECTED, 0.0, 2.0, PENDULUM.y0
        assert np.isfinite(reductions.lyapunov(*args))
        assert np.isnan(reductions.lyapunov(*args, **FAILS))

    def test_largest_values_are_infinite(self):
        both = diffrax.SaveAt(t0=True, t1=True)
        sol = dae_jax.daesolve(PENDULUM.system, PROJECTED, 0.0, 2.0, None, PENDULUM.y0, saveat=both, **FAILS)
        assert reductions.largest_drift(PENDULUM.system, sol) == np.inf
        assert reductions.energy_error(PENDULUM.system, sol) == np.inf

    @pytest.mark.parametrize("name", ["event", "saveat", "adjoint"])
    def test_what_ends_or_saves_early_is_refused(self, name):
        with pytest.raises(TypeError, match=f"`lyapunov` takes no `{name}`"):
            reductions.lyapunov(PENDULUM.system, PROJECTED, 0.0, 2.0, PENDULUM.y0, **{name: None})

    def test_an_exponent_of_no_time_is_refused(self):
        exponent = lambda t1: reductions.lyapunov(PENDULUM.system, PROJECTED, 1.0, t1, PENDULUM.y0)
        with pytest.raises(ValueError, match="to t1 = 1"):
            exponent(1.0)
        assert np.isnan(jax.jit(exponent)(1.0))


def test_what_is_not_traceable_is_refused_in_a_sentence():
    with pytest.raises(ValueError, match="`fn` must be traceable by JAX, but makes numbers of what it is given"):
        dae_jax.sweep(lambda angle: float(angle), np.linspace(0, 1, 3), progress=False)


@pytest.mark.parametrize(("gigabytes", "lanes"), [(80, 2**17), (1, 2**13), (1e-6, 1)])
def test_a_chunk_fits_the_memory_of_a_gpu(gigabytes, lanes):
    """1,000 numbers of 8 bytes an element, of which a sixteenth of the memory holds so many."""
    gpu = types.SimpleNamespace(platform="gpu", memory_stats=lambda: {"bytes_limit": int(gigabytes * 2**30)})
    assert sweep_file._lanes(lambda x: jnp.full(1000, x), np.ones(5), gpu) == lanes


def test_a_chunk_of_a_cpu_is_a_number_of_vectors():
    assert sweep_file._lanes(lambda x: 1 / 0, np.ones(5), jax.devices("cpu")[0]) == 512
