"""What keeps the first answer from being waited for: what is compiled, by whom, and that it is said."""

import dataclasses
import gc
import sys
import threading
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax
from dae_jax import scenes
from dae_jax.compiler import equations, kernel_call, waiting, without_checks, xla_kernel
from dae_jax.compiler.emit import object_code
from dae_jax.compiler.lower import annotate, compiled, unsupported
from dae_jax.compiler.thresholds import THRESHOLDS
from dae_jax.solve import prepared


X = np.array([1.0, 2.0, -3.0])


def repeated(x, count):
    for _ in range(count):
        x = jnp.sin(x) + x[::-1]
    return x


class TestCost:
    def test_what_moves_entries_takes_nothing(self):
        moving = jax.make_jaxpr(lambda x: jnp.stack([x[::-1], x]).T.reshape(-1)[2:])(X)
        assert annotate(moving).cost == 0

    def test_what_is_known_is_not_written(self, monkeypatch):
        """The estimate knows of no zeros: between one and four times the limit the function is written to see."""
        lowered = dataclasses.replace(THRESHOLDS, instructions=500)
        monkeypatch.setattr("dae_jax.compiler.lower.judge.THRESHOLDS", lowered)
        jaxpr = jax.make_jaxpr(lambda x: repeated(x, 10) + repeated(jnp.zeros(16), 30))(jnp.arange(16.0))
        assert annotate(jaxpr).cost > 500
        assert unsupported(jaxpr) == ()
        assert [
            found.primitive for found in unsupported(jax.make_jaxpr(lambda x: repeated(x, 40))(jnp.arange(16.0)))
        ] == ["size"]

    def test_factorials_of_taylor_arithmetic_do_not_hinder(self):
        jaxpr = jax.make_jaxpr(lambda x: x * jax.lax.exp(jax.lax.lgamma(4.0)))(X)
        assert unsupported(jaxpr) == ()
        np.testing.assert_allclose(compiled(jaxpr)(X)[0], 6 * X, rtol=1e-15)


class TestCheaperForms:
    def test_a_large_module_is_compiled_without_passes(self, monkeypatch):
        monkeypatch.setattr(object_code, "HEAVY", 0)
        monkeypatch.setattr(
            object_code, "_optimise", lambda _: (_ for _ in ()).throw(AssertionError("passes were run"))
        )
        found = compiled(jax.make_jaxpr(lambda x: jnp.sum(jnp.sin(x) * jnp.cos(x)) + 0.731)(X))(X)
        np.testing.assert_allclose(found[0], np.sum(np.sin(X) * np.cos(X)) + 0.731, rtol=1e-14)

    def test_xla_makes_no_single_kernel_of_a_large_function(self, monkeypatch):
        jaxpr = jax.make_jaxpr(lambda x: repeated(x, 20))(X)
        assert xla_kernel.qualifies(jaxpr)
        monkeypatch.setattr(xla_kernel, "LIMIT", 30)
        assert xla_kernel.unsupported(jaxpr) == ("size",)
        assert not xla_kernel.qualifies(jaxpr)


class Clock:
    """In place of `threading.Timer`: nothing happens before `pass_by`."""

    timers: ClassVar[list["Clock"]] = []

    def __init__(self, delay, action):
        self.delay, self.action, self.done = delay, action, False
        Clock.timers.append(self)

    def start(self):
        self.started = True

    def cancel(self):
        self.done = True

    @classmethod
    def pass_by(cls, seconds):
        for timer in cls.timers:
            if timer.started and not timer.done and timer.delay <= seconds:
                timer.action()


@pytest.fixture
def clock(monkeypatch):
    Clock.timers = []
    monkeypatch.setattr(waiting.threading, "Timer", Clock)
    return Clock


def solved(late=0.0, **options):
    """A solve that nothing has compiled before; `late`: how much time passes by meanwhile."""

    def force(t, q, v, args):
        Clock.pass_by(late)
        return jnp.array([0.0, 9.81])

    system = dae_jax.ConstrainedSystem(force, lambda t, q, args: (q @ q - 1) / 2)
    start = jnp.array([1.0, 0.0]), jnp.zeros(2)
    solve = lambda: dae_jax.daesolve(system, diffrax.Euler(), 0.0, 0.1, 0.1, start, **options)
    return solve(), solve()


SYSTEM = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, 9.81]), lambda t, q, args: (q @ q - 1) / 2)


class TestNotice:
    LINE = "dae_jax: compiling …\n"

    def test_after_two_seconds_on_a_terminal(self, clock, capsys, monkeypatch):
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
        solved(late=1.9)
        assert capsys.readouterr().err == ""
        solved(late=2.1)
        assert self.LINE in capsys.readouterr().err
        clock.pass_by(100.0)
        assert capsys.readouterr().err == "", "no line once it is compiled"

    def test_not_where_nobody_looks(self, clock, capsys):
        solved(late=100.0)
        assert capsys.readouterr().err == ""

    def test_where_a_progress_meter_is_asked_for(self, clock, capsys):
        meter = diffrax.TextProgressMeter()
        solved(late=100.0, progress_meter=meter)
        assert self.LINE in capsys.readouterr().err

    def test_an_error_ends_the_wait(self, clock, capsys, monkeypatch):
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
        waits = []

        def refuse(*_):
            waits.append(len(clock.timers))
            raise ArithmeticError("no force")

        system = dae_jax.ConstrainedSystem(refuse, lambda t, q, args: (q @ q - 1) / 2)
        with pytest.raises(ValueError, match="no force"):
            dae_jax.daesolve(system, diffrax.Euler(), 0.0, 0.1, 0.1, (jnp.array([1.0, 0.0]), jnp.zeros(2)))
        clock.pass_by(100.0)
        assert waits
        assert capsys.readouterr().err == ""


def test_stats_tell_the_time_to_compile():
    first, second = solved()
    assert first.stats["compile_seconds"] > 0
    assert second.stats["compile_seconds"] == 0


def test_inside_jit_there_is_no_time_to_tell():
    def end():
        sol = dae_jax.daesolve(SYSTEM, diffrax.Euler(), 0.0, 0.1, 0.1, (jnp.array([1.0, 0.0]), jnp.zeros(2)))
        return sol.stats

    assert "compile_seconds" not in jax.jit(end)()


class TestGarbage:
    @pytest.fixture(autouse=True)
    def _restored(self):
        before = gc.get_threshold()
        yield
        gc.set_threshold(*before)

    def test_is_looked_for_rarely_while_compiling(self):
        seen = []
        gc.set_threshold(700, 10, 10)
        system = dae_jax.ConstrainedSystem(
            lambda t, q, v, args: seen.append(gc.get_threshold()) or -q, SYSTEM.constraint
        )
        dae_jax.daesolve(system, diffrax.Euler(), 0.0, 0.1, 0.1, (jnp.array([1.0, 0.0]), jnp.zeros(2)))
        assert waiting.RARELY in seen
        assert gc.get_threshold() == (700, 10, 10)

    def test_threads_put_back_what_was_there(self):
        gc.set_threshold(700, 10, 10)
        waiting.begin()
        other = threading.Thread(target=waiting.begin)
        other.start()
        other.join()
        waiting.end()
        assert gc.get_threshold() == waiting.RARELY
        waiting._of_thread.notice = waiting._Silent()  # as in the other thread
        waiting.end()
        assert gc.get_threshold() == (700, 10, 10)

    def test_a_collector_that_is_off_stays_off(self):
        gc.set_threshold(0)
        waiting.begin()
        assert gc.get_threshold()[0] == 0
        waiting.end()
        assert gc.get_threshold()[0] == 0


@pytest.mark.parametrize(
    ("scene", "saveat"),
    [
        (scenes.double_pendulum(), diffrax.SaveAt(t1=True)),
        (scenes.four_bar(), diffrax.SaveAt(ts=np.linspace(0, 1, 11))),
    ],
    ids=["double pendulum", "four bars"],
)
def test_dummy_derivatives_of_a_mechanism_are_not_left_to_xla(scene, saveat):
    """As they are traced they have a multitude of equations, half of them there twice, and factorials."""
    solve, problem = prepared(
        scene.system, dae_jax.DOP853(), 0.0, 1.0, None, scene.y0, None, dae_jax.DummyDerivatives(),
        saveat, None, diffrax.RecursiveCheckpointAdjoint(), None, 4096, diffrax.NoProgressMeter(),
    )  # fmt: skip
    kernel, arrays = solve.kernel(problem)
    jaxpr = jax.make_jaxpr(without_checks(kernel))(arrays)
    assert sum(v.aval.size for eqn in equations(jaxpr) for v in eqn.outvars) > 60_000
    assert kernel_call.decision(jaxpr).compiler == "llvm"


@pytest.mark.parametrize("kind", ["event", "reset"])
def test_the_derivative_of_an_event_is_not_left_to_xla(kind, monkeypatch):
    """The linear solve in the derivative of its time looks at its result, which a kernel cannot."""
    made_by = []
    decided = kernel_call._decided
    monkeypatch.setattr(kernel_call, "_decided", lambda *args: made_by.append(decided(*args)) or made_by[-1])
    level = lambda t, y, args, **_: y[0][0] - 0.9
    event, adjoint = diffrax.Event(level, optimistix.Newton(1e-8, 1e-8)), diffrax.RecursiveCheckpointAdjoint()
    if kind == "reset":
        event, adjoint = dae_jax.Reset(level, lambda t, y, args: ((y[0], -y[1]), args)), diffrax.ForwardMode()

    system = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, args]), SYSTEM.constraint)

    def end(gravity):
        y0 = (jnp.array([1.0, 0.0]), jnp.zeros(2))
        sol = dae_jax.daesolve(
            system,
            dae_jax.OrthogonalProjection(diffrax.Tsit5()),
            0.0,
            2.0,
            None,
            y0,
            gravity,
            event=event,
            adjoint=adjoint,
        )
        return sol.ts[-1] + sol.ys[0][-1, 0]

    assert abs((jax.grad if kind == "event" else jax.jacfwd)(end)(9.81)) > 1e-3
    # What is between the parts of a solve with a reset has in it what raises where a derivative has no steps.
    left = {x.primitive for found in made_by for x in found.unsupported}
    assert left <= ({"pure_callback"} if kind == "reset" else set())
    assert "llvm" in {found.compiler for found in made_by}


def test_passes_are_run_where_they_gain_more_than_they_take():
    address, loop = "%p = getelementptr double, ptr %a, i64 %i\n", "%i = phi i64 [ 0, %entry ], [ %j, %body ]\n"
    assert object_code._gains_by_passes(address * (object_code.ADDRESSES - 1) + loop * object_code.LOOPS)
    assert not object_code._gains_by_passes(address * object_code.ADDRESSES)
    assert not object_code._gains_by_passes(loop * (object_code.LOOPS + 1))
    assert not object_code._gains_by_passes("\n" * object_code.HEAVY)


def test_equal_functions_are_looked_into_once():
    made_once = jax.jit(lambda x, scale: scale * jnp.sin(x))
    shape = (jax.ShapeDtypeStruct((3,), float),)
    first, _ = kernel_call._traced(lambda x: made_once(x, 2.0), shape)
    assert kernel_call._traced(lambda y: made_once(y, 2.0), shape)[0] is first
    assert kernel_call._traced(lambda x: made_once(x, 3.0), shape)[0] is not first
    assert kernel_call._traced(lambda x: made_once(x, 2.0) + 0, shape)[0] is not first
    assert kernel_call._traced(lambda x: made_once(x, 2.0), (jax.ShapeDtypeStruct((4,), float),))[0] is not first
    shifted = [lambda x, c=c: made_once(x, 2.0) + c for c in (np.zeros(3), np.zeros(3), np.ones(3))]
    zero, also_zero, one = (kernel_call._traced(fn, shape)[0] for fn in shifted)
    assert zero is also_zero is not one


def test_a_solve_within_another_program_is_looked_into_once():
    force, constraint = (lambda t, q, v, a: jnp.array([0.0, -a])), lambda t, q, a: (q @ q - 1) / 2
    system = dae_jax.ConstrainedSystem(force, constraint)
    y0 = (jnp.array([1.0, 0.0]), jnp.zeros(2))

    def height(a):
        sol = dae_jax.daesolve(system, dae_jax.OrthogonalProjection(diffrax.Heun()), 0.0, 0.1, 0.01, y0, a)
        return sol.ys[0][-1, 1]

    height(9.81)
    before = kernel_call._needed.cache_info()
    jax.jit(height)(9.81)
    after = kernel_call._needed.cache_info()
    assert after.hits > before.hits
    # What looks at its start and its end is traced anew.
    assert after.misses - before.misses <= 1
