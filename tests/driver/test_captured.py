"""A value that a function takes from around it, and that has changed between two calls, is seen: the second call gives what a
function that was written anew gives.
"""

import array
import collections
import contextvars
import ctypes
import functools
import sys
import types
import weakref
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import ConstrainedSystem, OrthogonalProjection
from dae_jax.driver import program
from dae_jax.validate.captured import current


SOLVER = OrthogonalProjection(diffrax.Tsit5())
START = (jnp.array([1.0, 0.0]), jnp.zeros(2))
K = 9.81
TABLE = {"k": 9.81, "deeper": [{"k": 0.0}]}
ARRAY = np.array([9.81])
SETTINGS = types.ModuleType("settings")
SETTINGS.k = 9.81


class Spring:
    def __init__(self, k):
        self.k = k

    def force(self, t, q, v, args):
        return jnp.array([0.0, self.k])

    def __call__(self, t, q, v, args):
        return self.force(t, q, v, args)


SPRING = Spring(9.81)


def helper():
    return K


def circle(t, q, args):
    return (q @ q - 1) / 2


def along(k):
    return jnp.array([0.0, k])


class Slotted:
    __slots__ = ("k",)


class OfClass:
    k = 9.81

    @property
    def doubled(self):
        return 2 * TABLE["k"]

    def of_global(self):
        return K


OF_CLASS = OfClass()
LAW = jnp.cos


def set_law(x):
    globals()["LAW"] = {9.81: jnp.cos}.get(x, jnp.sin)


def importing(t, q, v, args):
    import settings_of_a_test  # pyright: ignore[reportMissingImports]

    return along(settings_of_a_test.k)


sys.modules["settings_of_a_test"] = SETTINGS
SLOTTED, DEQUE, SET, NUMBERS = Slotted(), collections.deque([9.81]), {9.81}, array.array("d", [9.81])
SLOTTED.k = 9.81
PROXY = types.MappingProxyType(TABLE)


def set_of_one(x):
    SET.clear()
    SET.add(x)


VARIABLE = contextvars.ContextVar("k", default=9.81)
BYTES, CELLS, VIEWED = bytearray([9]), (ctypes.c_double * 1)(9.81), np.array([9.81])
VIEW, REFERENCE = memoryview(VIEWED), weakref.ref(SPRING)
MASKED = np.ma.array([9.81, 8.81 - 2 * 8.81], mask=[False, True])


def spring_behind() -> Any:
    return REFERENCE()


class Meta(type):
    k = 9.81


class OfMeta(metaclass=Meta):
    pass


def set_byte(x):
    BYTES[0] = int(x)


def set_mask(x):
    """The sum is 9.81 or 1."""
    MASKED.mask = [False, x == 9.81]


class Case:
    """A force that takes its value from somewhere, and how that is changed."""

    def __init__(self, force, change):
        self.force, self.change = force, change


def of_a_closure():
    k = 9.81

    def change(x):
        nonlocal k
        k = x

    return Case(lambda t, q, v, args: along(k), change)


def of_a_partial():
    table = {"k": 9.81}
    return Case(functools.partial(lambda table, t, q, v, args: along(table["k"]), table), lambda x: table.update(k=x))


def of_a_default():
    table = {"k": 9.81}

    def force(t, q, v, args, table=table):
        return along(table["k"])

    return Case(force, lambda x: table.update(k=x))


def set_global(x):
    globals()["K"] = x


CASES = {
    "a global": lambda: Case(lambda t, q, v, args: along(K), set_global),
    "a global of a function that is called": lambda: Case(lambda t, q, v, args: along(helper()), set_global),
    "a dictionary": lambda: Case(lambda t, q, v, args: along(TABLE["k"]), lambda x: TABLE.update(k=x)),
    "a dictionary in a list": lambda: Case(
        lambda t, q, v, args: along(9.81 + TABLE["deeper"][0]["k"]), lambda x: TABLE["deeper"][0].update(k=x - 9.81)
    ),
    "an array in place": lambda: Case(lambda t, q, v, args: along(ARRAY[0]), lambda x: ARRAY.fill(x)),
    "an attribute": lambda: Case(lambda t, q, v, args: along(SPRING.k), lambda x: setattr(SPRING, "k", x)),
    "a module": lambda: Case(lambda t, q, v, args: along(SETTINGS.k), lambda x: setattr(SETTINGS, "k", x)),
    "a method": lambda: Case((spring := Spring(9.81)).force, lambda x: setattr(spring, "k", x)),
    "an object that is called": lambda: Case(spring := Spring(9.81), lambda x: setattr(spring, "k", x)),
    "slots": lambda: Case(lambda t, q, v, args: along(SLOTTED.k), lambda x: setattr(SLOTTED, "k", x)),
    "a deque": lambda: Case(lambda t, q, v, args: along(DEQUE[0]), lambda x: DEQUE.__setitem__(0, x)),
    "a set": lambda: Case(lambda t, q, v, args: along(max(SET)), set_of_one),
    "an array of Python's": lambda: Case(lambda t, q, v, args: along(NUMBERS[0]), lambda x: NUMBERS.__setitem__(0, x)),
    "a view of a dictionary": lambda: Case(lambda t, q, v, args: along(PROXY["k"]), lambda x: TABLE.update(k=x)),
    "a class": lambda: Case(lambda t, q, v, args: along(OfClass.k), lambda x: setattr(OfClass, "k", x)),
    "the class of an object": lambda: Case(
        lambda t, q, v, args, of=OF_CLASS: along(of.k), lambda x: setattr(OfClass, "k", x)
    ),
    "a property": lambda: Case(lambda t, q, v, args, of=OF_CLASS: along(of.doubled / 2), lambda x: TABLE.update(k=x)),
    "a global of a method": lambda: Case(lambda t, q, v, args, of=OF_CLASS: along(of.of_global()), set_global),
    "a module that it imports": lambda: Case(importing, lambda x: setattr(SETTINGS, "k", x)),
    "a context variable": lambda: Case(lambda t, q, v, args: along(VARIABLE.get()), VARIABLE.set),
    "a global by its name": lambda: Case(lambda t, q, v, args: along(globals()["K"]), set_global),
    "a global in a text": lambda: Case(lambda t, q, v, args: along(eval("1 * K")), set_global),
    "bytes": lambda: Case(lambda t, q, v, args: along(BYTES[0] + 0.81 * (BYTES[0] > 1)), set_byte),
    "a view of memory": lambda: Case(lambda t, q, v, args: along(VIEW[0]), VIEWED.fill),
    "an array of C": lambda: Case(lambda t, q, v, args: along(CELLS[0]), lambda x: CELLS.__setitem__(0, x)),
    "a weak reference": lambda: Case(lambda t, q, v, args: along(spring_behind().k), lambda x: setattr(SPRING, "k", x)),
    "a metaclass": lambda: Case(lambda t, q, v, args: along(OfMeta.k), lambda x: setattr(Meta, "k", x)),
    "a mask": lambda: Case(lambda t, q, v, args: along(float(MASKED.sum())), set_mask),
    "a closure": of_a_closure,
    "a partial": of_a_partial,
    "a default": of_a_default,
}


@pytest.fixture(params=CASES)
def case(request):
    found = CASES[request.param]()
    yield found
    found.change(9.81)


def end(system, **options):
    return dae_jax.daesolve(system, SOLVER, 0.0, 1.0, None, START, **options).ys[0][-1]


def test_in_a_solve(case, nothing_forgotten):
    system = ConstrainedSystem(case.force, circle)
    before, count = end(system), program._jitted._cache_size()
    assert np.array_equal(end(system), before)
    assert program._jitted._cache_size() == count
    case.change(1.0)
    assert np.array_equal(end(system), end(ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, 1.0]), circle)))
    case.change(9.81)
    count = program._jitted._cache_size()
    assert np.array_equal(end(system), before)
    assert program._jitted._cache_size() == count


def test_a_name_that_stands_for_another_function_of_a_library():
    system = ConstrainedSystem(lambda t, q, v, args: along(LAW(t)), circle)
    before = end(system)
    set_law(1.0)
    try:
        assert not np.array_equal(end(system), before)
    finally:
        set_law(9.81)


def test_a_module_with_a_large_container_beside_what_changes():
    module = types.ModuleType("tables")
    module.many, module.k = [[float(k)] for k in range(100_000)], 9.81
    system = ConstrainedSystem(lambda t, q, v, args: along(module.k + 0 * module.many[0][0]), circle)
    before = end(system)
    module.k = 1.0
    assert not np.array_equal(end(system), before)


def test_in_a_derivative_of_a_closure():
    table = {"k": 1.0}

    def loss(scale):
        system = ConstrainedSystem(lambda t, q, v, args: scale * along(table["k"]), circle)
        return end(system)[1]

    before = jax.grad(loss)(1.0)
    table["k"] = 2.0
    assert jax.grad(loss)(1.0) == pytest.approx(float(jax.grad(lambda s: loss(s))(1.0)))
    table["k"] = 1.0
    assert jax.grad(loss)(1.0) == before
    step = 1e-4
    assert float(before) == pytest.approx(float(loss(1 + step) - loss(1 - step)) / (2 * step), rel=1e-5)


class TestCounters:
    """A function that counts its calls does not become another one by that."""

    @pytest.fixture(params=["list", "dictionary", "nonlocal"])
    def counted(self, request):
        # pytest's request leads to all there is.
        count, calls, table, kind = 0, [], {"calls": 0}, request.param

        def force(t, q, v, args):
            nonlocal count
            if kind == "list":
                calls.append(1)
            elif kind == "dictionary":
                table["calls"] += 1
            else:
                count += 1
            return jnp.array([0.0, 9.81])

        return ConstrainedSystem(force, circle), lambda: count + len(calls) + table["calls"]

    def test_a_solve(self, counted):
        system, calls = counted
        end(system)
        before = calls()
        end(system)
        assert calls() == before

    def test_a_gradient(self, counted):
        system, calls = counted
        gradient = jax.grad(lambda y: dae_jax.daesolve(system, SOLVER, 0.0, 1.0, None, (START[0], y)).ys[0][-1, 1])
        for _ in range(3):
            before = calls()
            gradient(START[1])
        assert calls() == before

    def test_rank_that_is_found(self):
        calls = []
        system = ConstrainedSystem(
            lambda t, q, v, args: calls.append(1) or jnp.array([0.0, 9.81]),
            lambda t, q, args: jnp.stack([circle(t, q, args)] * 2),
        )
        end(system)
        before = len(calls)
        end(system)
        assert len(calls) == before

    def test_args(self):
        table = {"k": 9.81}
        system = ConstrainedSystem(lambda t, q, v, args: along(args()), circle)
        before = end(system, args=lambda: table["k"])
        fn = lambda: table["k"]
        assert np.array_equal(end(system, args=fn), before)
        table["k"] = 1.0
        assert not np.array_equal(end(system, args=fn), before)


def test_what_changes_before_a_derivative_is_traced_is_a_change():
    table = {"k": 1.0}
    system = ConstrainedSystem(lambda t, q, v, args: jnp.array([-table["k"] * q[0], 0.0]), lambda t, q, args: q[1])

    def position(x):
        return dae_jax.daesolve(system, SOLVER, 0.0, 1.0, None, (jnp.array([x, 0.0]), jnp.zeros(2))).ys[0][0, 0]

    _, pull = jax.vjp(position, 1.0)
    table["k"] = 4.0
    assert pull(1.0)[0] == pytest.approx(np.cos(1))
    assert position(1.0) == pytest.approx(np.cos(2))
    assert jax.grad(position)(1.0) == pytest.approx(np.cos(2))


class Module(eqx.Module):
    scale: jax.Array

    def __call__(self, t, q, v, args):
        return along(self.scale * K)


@pytest.mark.parametrize("where", ["the class of a module", "an array of objects", "a dictionary's attribute"])
def test_in_other_places(where):
    objects, own = np.array([9.81], object), type("Own", (dict,), {})()
    own.k = 9.81
    force, args, change = {
        "the class of a module": (Module(jnp.ones(())), None, set_global),
        "an array of objects": (lambda t, q, v, args: along(objects[0]), None, lambda x: objects.fill(x)),
        "a dictionary's attribute": (lambda t, q, v, args: along(own.k), None, lambda x: setattr(own, "k", x)),
    }[where]  # fmt: skip
    system = ConstrainedSystem(force, circle)
    try:
        before = end(system, args=args)
        assert np.array_equal(end(system, args=args), before)
        change(1.0)
        assert np.array_equal(end(system, args=args), end(ConstrainedSystem(lambda t, q, v, args: along(1.0), circle)))
    finally:
        change(9.81)


def test_a_module_keeps_its_derivatives():
    loss = lambda scale: end(ConstrainedSystem(Module(scale), circle))[0]
    step = 1e-5
    expected = (loss(jnp.asarray(1 + step)) - loss(jnp.asarray(1 - step))) / (2 * step)
    assert float(jax.grad(loss)(jnp.ones(()))) == pytest.approx(float(expected), rel=1e-4)


class TestElsewhere:
    """In everything that keeps what it has compiled."""

    @pytest.fixture
    def length(self):
        """A constraint whose rod has a length that changes."""
        table = {"length": 1.0}
        return table, ConstrainedSystem(
            lambda t, q, v, args: jnp.array([0.0, -9.81]), lambda t, q, args: q @ q - table["length"] ** 2
        )

    def test_start(self, length):
        table, system = length
        end(system)
        table["length"] = 2.0
        with pytest.raises(ValueError, match="violates"):
            end(system)

    def test_consistent_state(self, length):
        table, system = length
        assert np.allclose(dae_jax.consistent_state(system, 0.0, START)[0], [1, 0])
        table["length"] = 2.0
        assert np.allclose(dae_jax.consistent_state(system, 0.0, START)[0], [2, 0])

    def test_drift_and_multipliers(self, length):
        table, system = length
        sol = dae_jax.daesolve(system, SOLVER, 0.0, 1.0, None, START)
        assert float(dae_jax.drift(system, sol).position[-1]) < 1e-12
        table["length"] = 2.0
        assert float(dae_jax.drift(system, sol).position[-1]) == pytest.approx(3)

    def test_sweep(self):
        table = {"k": 9.81}
        system = ConstrainedSystem(lambda t, q, v, args: along(table["k"]), circle)
        fn = lambda scale: scale * end(system)[1]
        before = dae_jax.sweep(fn, jnp.arange(2.0), progress=False)
        table["k"] = 1.0
        after = dae_jax.sweep(fn, jnp.arange(2.0), progress=False)
        assert after[1] == pytest.approx(float(end(system)[1]), rel=1e-12)
        assert abs(float(after[1] - before[1])) > 0.1


def test_a_function_of_this_library_stays_what_it_is():
    force = dae_jax.scenes.pendulum().system.force
    assert current(force) is force


def made(k, xp=jnp, doubled=False):
    """A force that is made anew in each call."""
    scale = np.array([0.0, k])
    inner = lambda x: 2 * x if doubled else x
    return lambda t, q, v, args: xp.asarray(inner(scale)) + 0 * q


def test_a_function_that_is_made_anew_is_the_same_one(nothing_forgotten):
    assert current(made(1.0)) == current(made(1.0))
    assert current(lambda t: t) != current(lambda t: t + 1)
    assert current(lambda t: 1) != current(lambda t: 1.0)
    solve = lambda *of, **options: end(ConstrainedSystem(made(*of, **options), lambda t, q, args: (q @ q - 1) / 2))
    first, count = solve(9.81), program._jitted._cache_size()
    assert np.array_equal(solve(9.81), first)
    assert program._jitted._cache_size() == count
    for others in ({"k": 1.0}, {"k": 9.81, "doubled": True}):
        assert not np.array_equal(solve(**others), first)
    # Another module under the name of one.
    assert current(made(1.0, np)) != current(made(1.0, jnp))
    with_attribute = [made(1.0), made(1.0)]
    with_attribute[0].k = 1
    assert current(with_attribute[0]) != current(with_attribute[1])
    arrays = [jnp.zeros(3), jnp.zeros(3), jnp.ones(3), jnp.zeros(3, jnp.float32), jnp.zeros((3, 1))]
    closing = lambda x: lambda: x
    of = [current(closing(x)) for x in arrays]
    assert [f == of[0] for f in of] == [True, True, False, False, False]


def test_what_is_made_anew_is_not_taken_for_one_that_has_changed_since():
    """A derivative may be traced later than the value, when what is around the first of two equal functions is another."""

    def pulled(table):
        return lambda t, q, v, args: table["k"]

    def held(table):
        found = Held(0.0)
        found.deeper = table
        return found

    first, second = {"k": 9.0}, {"k": 9.0}
    by_first, of_first = current(pulled(first)), current(held(first))
    first["k"] = 1.0
    by_second, of_second = current(pulled(second)), current(held(second))
    assert by_first == by_second
    assert by_first(0.0, None, None, None) == by_second(0.0, None, None, None) == 9.0
    assert (of_first.deeper["k"], of_second.deeper["k"]) == (1.0, 9.0)


def test_a_mechanism_that_is_made_anew_is_compiled_once(nothing_forgotten):
    from dae_jax import mechanisms as m

    def angle(length, strength):
        bar = m.Body("bar", 1.0, 0.1, at=(length, 0.0))
        hinge = m.revolute(m.ground, bar, (0.0, 0.0), name="hinge")
        motor = m.motor(hinge, torque=lambda t, c, rate, args: strength * jnp.sin(t) - 0.1 * rate)
        mechanism = m.Mechanism([bar], [hinge], [motor])
        sol = dae_jax.daesolve(mechanism.system(), SOLVER, 0.0, 1.0, None, mechanism.reference)
        return mechanism.coordinate(sol, "hinge")[-1]

    slope = jax.grad(lambda length: angle(length, 2.0))
    first, count = slope(1.0), program._jitted._cache_size()
    by_differences = (angle(1.1 + 1e-5, 2.0) - angle(1.1 - 1e-5, 2.0)) / 2e-5
    assert slope(1.1) == pytest.approx(float(by_differences), rel=1e-4)
    assert first != slope(1.1)
    assert program._jitted._cache_size() <= count + 1  # of the differences
    assert abs(angle(1.0, 2.0) - angle(1.0, 3.0)) > 1e-2


def test_a_network_is_known_by_its_weights():
    network = eqx.nn.MLP(2, 2, 4, 1, key=jax.random.key(0))
    fn = lambda t, q, v, args: network(q)
    before = current(fn)
    assert current(fn) == before
    network = eqx.tree_at(lambda n: n.layers[0].bias, network, jnp.ones(4))
    assert current(fn) != before


def test_what_is_large_is_known_by_what_it_is():
    many = [[float(k)] for k in range(100_000)]
    fn = lambda: many[0]
    assert current(fn) == current(fn)
    many[0][0] = 1.0
    assert current(fn) == current(fn)


@pytest.mark.parametrize("change", ["an entry", "a key", "beside"])
def test_what_is_large_is_looked_into_all_the_same(change):
    holder = types.SimpleNamespace(
        many=[float(k) for k in range(100_000)],
        keys=dict.fromkeys(range(10_000), 0.0),
        deep=[[k] for k in range(10_000)],
        k=1,
    )
    fn = lambda: holder.many[0] + holder.deep[0][0] + holder.k
    before = current(fn)
    assert current(fn) == before
    if change == "an entry":
        holder.many[70_000] = 1.5
    elif change == "a key":
        holder.keys[70] = "0.0"
    else:
        holder.k = 2
    assert current(fn) != before


class Held:
    """An object that is no pytree."""

    def __init__(self, k):
        self.k = k
        self.deeper = {"k": 0.0}


@pytest.mark.parametrize("deep", [False, True])
def test_an_object_in_the_arguments(deep, nothing_forgotten):
    """It may change between two calls, which is seen everywhere; a solution keeps the one that it was computed with."""
    held = Held(9.81)
    system = ConstrainedSystem(
        lambda t, q, v, args: along(args["of"].k + args["of"].deeper["k"]),
        circle,
        potential=lambda q, args: -(args["of"].k + args["of"].deeper["k"]) * q[1],
    )
    solved = lambda: dae_jax.daesolve(system, SOLVER, 0.0, 1.0, None, START, {"of": held})
    at_a_point = lambda: float(dae_jax.multipliers(system, 0.0, jnp.array([0.0, 1.0]), jnp.zeros(2), {"of": held})[0])
    first, pulled = solved(), at_a_point()
    assert pulled == pytest.approx(9.81)
    if deep:
        held.deeper["k"] = -8.81
    else:
        held.k = 1.0
    second = solved()
    plain = end(ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, 1.0]), circle))
    assert np.allclose(second.ys[0][-1], plain, atol=1e-12)
    assert at_a_point() == pytest.approx(1.0)
    assert not np.allclose(first.ys[0][-1], plain, atol=0.1)
    assert float(dae_jax.energy(system, second)[-1]) == pytest.approx(0.0, abs=1e-6)
    if not deep:
        assert float(dae_jax.energy(system, first)[-1]) == pytest.approx(0.0, abs=1e-6)
    count = program._jitted._cache_size()
    solved()
    assert program._jitted._cache_size() == count


def test_an_object_in_the_arguments_of_a_state_that_is_sought():
    held = Held(2.0)
    system = dae_jax.ImplicitDAE(lambda t, y, yd, args: [yd[0] + y[0], y[1] - args.k * y[0]])
    sought = lambda: dae_jax.consistent_state(system, 0.0, jnp.array([1.0, 0.0]), held, fixed=jnp.array([True, False]))
    assert sought()[1] == pytest.approx(2.0)
    held.k = 3.0
    assert sought()[1] == pytest.approx(3.0)


@pytest.mark.parametrize("held", [types.SimpleNamespace(k=1.0), {1.0}], ids=["without a hash", "a set"])
def test_an_object_in_the_arguments_that_is_refused(held):
    with pytest.raises(TypeError, match="is no pytree: JAX does not see the numbers in it"):
        end(ConstrainedSystem(lambda t, q, v, args: along(9.81), circle), args=held)
