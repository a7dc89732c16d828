"""Compiled kernels: loops along a horizon, compiled by numba when they are called first.

A kernel's signature is read off its annotations, so that mypy and numba check the same words: an
array is annotated with one of the types below, an array of records with one made of its dtype, and
arrays that travel together with their NamedTuple. A record is told by a class, a line a field; none
is ever made of it, but it names the type of a record to mypy. A part is a function that only
kernels call; it is compiled into each of them.

What must not wait in flight compiles them before: `missing` tells which have no machine code yet,
`load` has all of them ready. Importing them compiles nothing.

Machine code is kept on disk, beside the sources or where NUMBA_CACHE_DIR says. Numba looks at the
kernel's own file to see whether it is still right; here every function and constant that a kernel
reaches counts, in whichever module it stands, so that no kernel flies by a rule that has changed.
"""

import hashlib
import inspect
import linecache
from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

import numba
import numpy as np
from numba.core import caching, compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import rtsys
from numba.extending import register_jitable
from numpy.typing import NDArray

from skytether.shared.base.compilable import COMPILABLE

F = TypeVar("F", bound=Callable[..., Any])

F1 = Annotated[NDArray[np.float64], numba.float64[::1]]
F2 = Annotated[NDArray[np.float64], numba.float64[:, ::1]]
R1 = Annotated[NDArray[np.float64], numba.types.Array(numba.float64, 1, "C", readonly=True)]
R2 = Annotated[NDArray[np.float64], numba.types.Array(numba.float64, 2, "C", readonly=True)]
F3 = Annotated[NDArray[np.float64], numba.float64[:, :, ::1]]
F4 = Annotated[NDArray[np.float64], numba.float64[:, :, :, ::1]]
F5 = Annotated[NDArray[np.float64], numba.float64[:, :, :, :, ::1]]
I1 = Annotated[NDArray[np.int64], numba.int64[::1]]
I2 = Annotated[NDArray[np.int64], numba.int64[:, ::1]]
I3 = Annotated[NDArray[np.int64], numba.int64[:, :, ::1]]
S1 = Annotated[NDArray[np.float32], numba.float32[::1]]
S2 = Annotated[NDArray[np.float32], numba.float32[:, ::1]]
S3 = Annotated[NDArray[np.float32], numba.float32[:, :, ::1]]
S4 = Annotated[NDArray[np.float32], numba.float32[:, :, :, ::1]]
B1 = Annotated[NDArray[np.bool_], numba.boolean[::1]]
"""Contiguous arrays of float64 (F; R where they are only read), int64 (I), float32 (S) and bool
(B), by number of axes."""

SCALARS = {int: numba.int64, float: numba.float64, bool: numba.boolean}


CODES = {int: "i8", float: "f8", bool: "?"}
"""Numpy's code of the field of a record, by its annotation."""


def record(kind: type) -> np.dtype[np.void]:
    """Numpy dtype of a record, with a field for each annotation of a class."""
    fields = [(name, CODES[hint]) for name, hint in get_type_hints(kind).items()]
    return np.dtype(fields, align=True)


def records(dtype: np.dtype[np.void], ndim: int) -> Any:
    """The numba type of a contiguous array of such records, for an annotation."""
    return numba.types.Array(numba.from_dtype(dtype), ndim, "C")


def kernel(function: F) -> F:
    """A function, compiled at its first call for the types that its annotations name.

    It cannot make arrays: numba counts no references in it. Counting them is an atomic instruction
    for each array and slice, and took half of the time of a plan.
    """
    return _at_first_call(numba.njit(error_model="numpy", _nrt=False)(function))


def making_kernel(function: F) -> F:
    """A kernel that makes arrays of its own."""
    return _at_first_call(numba.njit(error_model="numpy")(function))


def _at_first_call(dispatcher: Any) -> Any:
    """A kernel that compiles for its annotations once it is called; its `dispatcher` is numba's.

    A dispatcher takes the types of all arguments at every call, to find the machine code for them:
    of 45 arrays in tuples that took 15 µs, and 70 µs where a tick comes every 50 ms and the caches
    are cold. There is one machine code only, so the types are checked at the first call, and the
    later ones go straight to it. `check_types` has every call checked.
    """

    def first(*arguments: Any) -> Any:
        _compile(dispatcher)
        answer = dispatcher(*arguments)
        (compiled,) = dispatcher.overloads.values()
        # A partial function of no arguments: its function can be changed, and calling it costs less
        # than a method would.
        code = dispatcher if _CHECKED else compiled.entry_point
        call.__setstate__((code, (), {}, call.__dict__))
        return answer

    call: Any = partial(first)
    call.dispatcher, call.py_func = dispatcher, dispatcher.py_func
    KERNELS.append(dispatcher)
    return call


_CHECKED: list[bool] = []
"""Holds something where the types of arguments are checked at every call of a kernel."""


def check_types() -> None:
    """From now on, check at each call of a kernel that its arguments are what it says: for tests.

    Kernels that have been called already go on as they are.
    """
    _CHECKED.append(True)


KERNELS: list[Any] = []
"""Kernels whose modules are imported, compiled or not."""


class Missing(NamedTuple):
    """A kernel without machine code in memory or on disk."""

    name: str
    """Module and name of the kernel, for `compile_named`."""
    is_kept: bool
    """Whether the machine code will be kept on disk."""
    compile: Callable[[], None]
    """Function that compiles it, or reads what another process has compiled since."""


def missing(without: Collection[str] = ()) -> list[Missing]:
    """Kernels without machine code in memory or on disk; those with the most to compile come first.

    Args:
        without: names of the modules whose kernels are not needed.
    """
    found = [
        each
        for each in KERNELS
        if each.__module__ not in without and not (each.overloads or _is_kept(each))
    ]
    return [
        Missing(
            _name(each), not isinstance(each._cache, caching.NullCache), partial(_compile, each)
        )
        for each in sorted(found, key=_extent, reverse=True)
    ]


def compile_named(name: str) -> None:
    """Compile the kernel that `Missing` names so."""
    import_module(name.partition(":")[0])
    (dispatcher,) = (each for each in KERNELS if _name(each) == name)
    _compile(dispatcher)


def _name(dispatcher: Any) -> str:
    return f"{dispatcher.__module__}:{dispatcher.py_func.__qualname__}"


def _extent(dispatcher: Any) -> int:
    """Number of arguments, with the parts of tuples, by which the time of compiling rises."""

    def parts(kind: Any) -> int:
        return sum(map(parts, kind)) if isinstance(kind, numba.types.BaseTuple) else 1

    return sum(map(parts, _signature(dispatcher)))


def load(without: Collection[str] = ()) -> None:
    """Load or compile every kernel, so that none has to be compiled in flight.

    Args:
        without: names of the modules whose kernels are not needed.
    """
    for each in KERNELS:
        if each.__module__ not in without:
            _compile(each)


def _is_kept(dispatcher: Any) -> bool:
    """Whether the machine code of a kernel is on disk."""
    _keep(dispatcher)
    cache = dispatcher._cache
    if isinstance(cache, caching.NullCache):
        return False
    key = cache._index_key(_signature(dispatcher), dispatcher.targetctx.codegen())
    return key in cache._cache_file._load_index()  # the code itself takes ten times as long


@global_compiler_lock  # type: ignore[untyped-decorator]
def _compile(dispatcher: Any) -> None:
    """Take the machine code of a kernel from the disk, or make it, once."""
    if dispatcher.overloads:
        return
    _keep(dispatcher)
    if dispatcher.targetoptions.get("_nrt", True):
        rtsys.initialize(dispatcher.targetctx)  # what counts references, which `Kept` leaves out
    signature = _signature(dispatcher)
    try:
        dispatcher.compile(signature)
    except OSError:  # the disk is full, say: it is compiled, and not kept
        dispatcher._cache = caching.NullCache()
        dispatcher.compile(signature)
    dispatcher.disable_compile()


def _keep(dispatcher: Any) -> None:
    """Cache machine code on disk, where there is a place for it."""
    if isinstance(dispatcher._cache, Kept):
        return
    with suppress(RuntimeError):  # no place can be written to
        dispatcher._cache = Kept(dispatcher.py_func)


def _signature(dispatcher: Any) -> tuple[Any, ...]:
    """Numba's types of the parameters, as they are annotated."""
    hints = get_type_hints(dispatcher.py_func, include_extras=True)
    hints.pop("return", None)
    return tuple(map(_type, hints.values()))


def _type(hint: Any) -> Any:
    """Numba's type for an annotation."""
    if hasattr(hint, "__metadata__"):
        kind = hint.__metadata__[0]
        # What flies aboard imports no numba: there a number of dimensions stands for the type.
        return numba.types.Array(numba.float64, kind, "C") if isinstance(kind, int) else kind
    if hasattr(hint, "_fields"):
        fields = get_type_hints(hint, include_extras=True)
        return numba.types.BaseTuple.from_types([*map(_type, fields.values())], hint)
    return SCALARS[hint]


def part(function: F) -> F:
    """A function that kernels call, once for a vehicle or an axis; it makes no arrays."""
    compiled: F = numba.njit(error_model="numpy", _nrt=False)(function)
    return compiled


def making_part(function: F) -> F:
    """A part that makes arrays of its own."""
    compiled: F = numba.njit(error_model="numpy")(function)
    return compiled


class Disjoint(compiler.Compiler):  # type: ignore[misc]
    """Numba's compiler for functions whose arrays share no memory.

    Numba promises that to LLVM of none of its own functions, and LLVM gives up on vectors where
    more than a few pairs of arrays would have to be compared in flight.
    """

    def define_pipelines(self) -> Any:
        """Numba's passes, with that promise."""
        self.state.flags.noalias = True
        return super().define_pipelines()


def lanes(function: F) -> F:
    """A part whose innermost loops go over lanes, side by side in vectors.

    No two of its arrays may share memory, unless both are only read.
    """
    compiled: F = numba.njit(error_model="numpy", _nrt=False, pipeline_class=Disjoint)(function)
    return compiled


def inline(function: F) -> F:
    """A function of a few numbers that kernels call at every stage."""
    compiled: F = numba.njit(error_model="numpy", _nrt=False, inline="always")(function)
    return compiled


def shared(function: F) -> F:
    """A function of `shared` as it is, which kernels may call as Python does; so what it calls."""
    for each in _reached(function):
        if inspect.isfunction(each) and each not in _SHARED:
            register_jitable(error_model="numpy")(each)
            _SHARED.add(each)
    return function


_SHARED: set[Callable[..., Any]] = set()
"""Functions that kernels may call as they are."""


def compile_all() -> None:
    """From now on, fly by machine code what `shared.base.compilable` marks, in this process."""
    for call in COMPILABLE:
        if call.func not in _PLAIN:
            if call.func not in _MACHINE:
                _MACHINE[call.func] = kernel(shared(call.func))
            _PLAIN[_MACHINE[call.func]] = call.func
            call.__setstate__((_MACHINE[call.func], (), {}, {}))


def interpret_all() -> None:
    """Fly by plain Python again what `compile_all` has compiled."""
    for call in COMPILABLE:
        if call.func in _PLAIN:
            call.__setstate__((_PLAIN[call.func], (), {}, {}))


_MACHINE: dict[Callable[..., Any], Any] = {}
"""Kernels by the functions that they were made of."""
_PLAIN: dict[Any, Callable[..., Any]] = {}
"""The other way round."""


def plain(function: F) -> F:
    """The function that a kernel or part was made of, to be called from Python now and then."""
    original: F = function.py_func  # type: ignore[attr-defined]
    return original


class Reaching:
    """Makes one of numba's cache locators mind everything that a kernel reaches."""

    def get_source_stamp(self) -> str:
        """Stamp that must be unchanged for machine code on disk to be used."""
        return self.stamp

    def get_disambiguator(self) -> str:
        """Part of the file's name: a file that another stamp belongs to is not even opened."""
        return self.stamp[:16]

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        """The locator of a kernel, or None where this place cannot be written to."""
        locator = super().from_function(py_func, py_file)  # type: ignore[misc]
        if locator is not None:
            locator.stamp = stamp(py_func)
        return locator

    stamp: str


class Given(Reaching, caching.UserProvidedCacheLocator):  # type: ignore[misc]
    """The folder that NUMBA_CACHE_DIR names."""


class Beside(Reaching, caching.InTreeCacheLocator):  # type: ignore[misc]
    """The folder `__pycache__` beside the source."""


class OfUser(Reaching, caching.UserWideCacheLocator):  # type: ignore[misc]
    """The user's own cache."""


class Places(caching.CompileResultCacheImpl):  # type: ignore[misc]
    """The places where machine code may be kept, in the order of preference."""

    _locator_classes = (Given, Beside, OfUser)


class Kept(caching.FunctionCache):  # type: ignore[misc]
    """Machine code of a kernel on disk.

    Before it looks there, numba's own cache imports all that its compiler knows of Python and
    numpy: 0.3 s and 36 MB. Machine code that is loaded needs none of that, and where some has to be
    made, the compiler imports it.
    """

    _impl_class = Places

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The machine code for a signature, or None where there is none."""
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def stamp(function: Callable[..., Any]) -> str:
    """A digest of a kernel, and of all types, compiled functions and constants that it reaches."""
    hints = get_type_hints(function, include_extras=True)
    found = {"types": repr([_type_name(hint) for hint in hints.values()])}
    for each in _reached(function):
        place = f"{each.__module__}.{each.__qualname__}"
        found[place] = _source(each)
        for name in each.__code__.co_names:
            value: Any = each.__globals__.get(name)
            if isinstance(value, type) and hasattr(value, "_fields"):
                found[f"{place}: {name}"] = _type_name(value)
            elif isinstance(value, int | float | str | tuple | np.dtype):
                found[f"{place}: {name}"] = repr(value)
    return hashlib.sha256(repr(sorted(found.items())).encode()).hexdigest()


def _reached(function: Callable[..., Any]) -> list[Callable[..., Any]]:
    """A function and all that it calls, as Python has them."""
    reached, waiting = [], [function]
    while waiting:
        each = waiting.pop()
        if each in reached:
            continue
        reached.append(each)
        for called in map(each.__globals__.get, each.__code__.co_names):
            plain_one: Any = getattr(called, "py_func", called)
            if inspect.isfunction(plain_one):
                waiting.append(plain_one)
    return reached


def _source(function: Callable[..., Any]) -> str:
    """Lines of a function's source, from its first decorator to its last instruction.

    `inspect.getsource` looks for the end with a tokenizer, which took 0.1 s of each start.
    """
    code = function.__code__
    end = max(line or 0 for _, line, _, _ in code.co_positions())
    return "".join(linecache.getlines(code.co_filename)[code.co_firstlineno - 1 : end])


def _type_name(hint: Any) -> str:
    """A type in words that differ where the type does, wherever it is defined."""
    if not hasattr(hint, "_fields"):
        return repr(hint)
    fields = get_type_hints(hint, include_extras=True)
    names = (f"{name}: {_type_name(field)}" for name, field in fields.items())
    return f"{hint.__module__}.{hint.__qualname__}({', '.join(names)})"
