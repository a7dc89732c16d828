"""Compiled kernels: loops along a horizon, compiled by numba on their first call.

A kernel's signature is taken from its annotations, so that mypy and numba check the same types: an
array is annotated with one of the types below, an array of records with a type made from its dtype,
and a group of arrays with its NamedTuple. A record is described by a class with one annotated field
per line, which is never instantiated but is the record's type for mypy. A part is a function that
only kernels call, and is compiled into each of them.

Processes that must not wait in flight compile kernels earlier: `machine_code.missing` lists the
kernels without machine code, `load` loads or compiles all kernels. Importing compiles nothing.

Machine code is stored on disk, beside the sources or in NUMBA_CACHE_DIR. Numba itself only checks
whether the kernel's own file has changed; here all functions and constants that a kernel uses, in
any module, are checked, so that outdated machine code is never used.
"""

import ctypes
import hashlib
import inspect
import linecache
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Annotated, Any, TypeVar, get_type_hints

import numba
import numpy as np
from numba.core import caching, codegen, compiler
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
I1 = Annotated[NDArray[np.int64], numba.int64[::1]]
I2 = Annotated[NDArray[np.int64], numba.int64[:, ::1]]
I3 = Annotated[NDArray[np.int64], numba.int64[:, :, ::1]]
S1 = Annotated[NDArray[np.float32], numba.float32[::1]]
S2 = Annotated[NDArray[np.float32], numba.float32[:, ::1]]
S3 = Annotated[NDArray[np.float32], numba.float32[:, :, ::1]]
S4 = Annotated[NDArray[np.float32], numba.float32[:, :, :, ::1]]
B1 = Annotated[NDArray[np.bool_], numba.boolean[::1]]
"""Contiguous arrays of float64 (F; R if only read), int64 (I), float32 (S) and bool (B), by number
of axes."""

SCALARS = {int: numba.int64, float: numba.float64, bool: numba.boolean}


CODES = {int: "i8", float: "f8", bool: "?"}


def record(kind: type) -> np.dtype[np.void]:
    fields = [(name, CODES[hint]) for name, hint in get_type_hints(kind).items()]
    return np.dtype(fields, align=True)


def records(dtype: np.dtype[np.void], ndim: int) -> Any:
    """Numba type of a contiguous array of records of a dtype, for an annotation."""
    return numba.types.Array(numba.from_dtype(dtype), ndim, "C")


def kernel(function: F) -> F:
    """Function that is compiled on its first call, for the types of its annotations.

    The function cannot create arrays, because it is compiled without reference counts, which would
    take half of the time of a plan: an atomic instruction per array and slice.
    """
    return _at_first_call(
        numba.njit(error_model="numpy", _nrt=False, pipeline_class=Called)(function)
    )


def making_kernel(function: F) -> F:
    return _at_first_call(numba.njit(error_model="numpy", pipeline_class=Called)(function))


def _at_first_call(dispatcher: Any) -> Any:
    """Kernel that is compiled for its annotations on the first call; `dispatcher` is numba's.

    A dispatcher determines the types of all arguments at every call to find the machine code for
    them: with 45 arrays in tuples this took 15 µs, and 70 µs when a tick comes every 50 ms and the
    caches are cold. Here there is only one machine code, so types are checked at the first call
    only, and later calls run it directly. With `check_types` every call is checked.
    """

    def first(*arguments: Any) -> Any:
        compile_kernel(dispatcher)
        answer = dispatcher(*arguments)
        (compiled,) = dispatcher.overloads.values()
        # A partial without arguments: the function in it can be replaced, and calling it costs less
        # than calling a method.
        code = dispatcher if _CHECKED else compiled.entry_point
        call.__setstate__((code, (), {}, call.__dict__))
        return answer

    call: Any = partial(first)
    call.dispatcher, call.py_func = dispatcher, dispatcher.py_func
    KERNELS.append(dispatcher)
    return call


_CHECKED: list[bool] = []
"""Not empty if the types of arguments are checked at every call of a kernel."""


def check_types() -> None:
    """From now on, check the types of arguments at each call of a kernel, for tests.

    Kernels that have been called already are not affected.
    """
    _CHECKED.append(True)


KERNELS: list[Any] = []


def load(without: Collection[str] = ()) -> None:
    """Load or compile every kernel, so that none has to be compiled in flight; `without` names
    modules to leave out.
    """
    for each in KERNELS:
        if each.__module__ not in without:
            compile_kernel(each)


@global_compiler_lock  # type: ignore[untyped-decorator]
def compile_kernel(dispatcher: Any) -> None:
    if dispatcher.overloads:
        return
    store_on_disk(dispatcher)
    if dispatcher.targetoptions.get("_nrt", True):
        rtsys.initialize(
            dispatcher.targetctx
        )  # sets up reference counting, which `KernelCache` does not
    signature = signature_of(dispatcher)
    try:
        dispatcher.compile(signature)
    except OSError:  # for example, a full disk: the kernel is compiled, but not stored
        dispatcher._cache = caching.NullCache()
        dispatcher.compile(signature)
    dispatcher.disable_compile()


def store_on_disk(dispatcher: Any) -> None:
    if isinstance(dispatcher._cache, KernelCache):
        return
    with suppress(RuntimeError):  # no folder is writable
        dispatcher._cache = KernelCache(dispatcher.py_func)


def signature_of(dispatcher: Any) -> tuple[Any, ...]:
    hints = get_type_hints(dispatcher.py_func, include_extras=True)
    hints.pop("return", None)
    return tuple(map(_type, hints.values()))


def _type(hint: Any) -> Any:
    if hasattr(hint, "__metadata__"):
        kind = hint.__metadata__[0]
        # Code aboard does not import numba: its annotations have a number of dimensions instead of
        # a type.
        return numba.types.Array(numba.float64, kind, "C") if isinstance(kind, int) else kind
    if hasattr(hint, "_fields"):
        fields = get_type_hints(hint, include_extras=True)
        return numba.types.BaseTuple.from_types([*map(_type, fields.values())], hint)
    return SCALARS[hint]


def part(function: F) -> F:
    """Function that only kernels call, for example once per vehicle; it creates no arrays."""
    return _for_any_constant(
        numba.njit(error_model="numpy", _nrt=False, pipeline_class=Linked)(function)
    )


def making_part(function: F) -> F:
    return _for_any_constant(numba.njit(error_model="numpy", pipeline_class=Linked)(function))


def _for_any_constant(dispatcher: Any) -> Any:
    """Part that is compiled once for all values of a constant argument.

    Numba would compile the part, and all functions that it calls, once for each constant passed: 24
    s of CPU instead of 15 for `server.mpc.hierarchical`.
    """
    whole = dispatcher.get_call_template

    def template(args: Sequence[Any], keywords: Mapping[str, Any]) -> Any:
        named = {name: numba.types.unliteral(kind) for name, kind in keywords.items()}
        return whole(tuple(map(numba.types.unliteral, args)), named)

    dispatcher.get_call_template = template
    return dispatcher


class PartLibrary(codegen.JITCodeLibrary):  # type: ignore[misc]
    """Code of a part: optimised and turned into machine code only within kernels that it is linked
    into.

    Numba would optimise and translate each function alone, and again in each caller, and make
    wrappers, which a part does not need: all kernels of `demo` took 21 s of CPU instead of 12.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:  # noqa: ARG002
        """Address for calls from Python, which raise a TypeError: a part has no separate code."""
        self._ensure_finalized()
        return NOT_CALLABLE

    @property
    def codegen(self) -> "PartLibrary":
        """Object on which numba calls `set_env`: the part itself."""
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Do nothing: a part uses the environment (Python objects) of its kernel."""


NOT_CALLABLE: int = ctypes.cast(ctypes.pythonapi.PyObject_Call, ctypes.c_void_p).value or 0
"""Address of PyObject_Call: it raises a TypeError, as a function's environment is not callable."""


class Called(compiler.Compiler):  # type: ignore[misc]
    """Numba's compiler for functions that Python code calls and C code does not."""

    def define_pipelines(self) -> Any:
        self.state.flags.no_cfunc_wrapper = True
        return super().define_pipelines()


class Linked(Called):
    """Numba's compiler for functions that only compiled functions call."""

    def define_pipelines(self) -> Any:
        self.state.flags.no_cpython_wrapper = True
        name, code = self.state.func_id.func_qualname, self.state.targetctx.codegen()
        self.state.library = PartLibrary(code, name)
        return super().define_pipelines()


class Disjoint(Linked):
    """Numba's compiler for functions whose arrays share no memory.

    Numba does not give LLVM this guarantee for its own functions, and LLVM does not vectorise if
    more than a few pairs of arrays would have to be compared at run time.
    """

    def define_pipelines(self) -> Any:
        self.state.flags.noalias = True
        return super().define_pipelines()


def lanes(function: F) -> F:
    """Part whose innermost loops iterate over vehicles, and are vectorised.

    No two of its arrays may share memory, unless both are only read.
    """
    options = {"error_model": "numpy", "_nrt": False, "pipeline_class": Disjoint}
    return _for_any_constant(numba.njit(**options)(function))


def inline(function: F) -> F:
    """Function of a few numbers that is inlined into kernels, which call it at every stage."""
    compiled: F = numba.njit(error_model="numpy", _nrt=False, inline="always")(function)
    return compiled


def shared(function: F) -> F:
    """Let kernels call a Python function and all functions that it calls; returns the function."""
    for each in _dependencies(function):
        if inspect.isfunction(each) and each not in _SHARED:
            register_jitable(error_model="numpy", pipeline_class=Linked)(each)
            _SHARED.add(each)
    return function


_SHARED: set[Callable[..., Any]] = set()


def compile_all() -> None:
    """From now on, in this process, use machine code for the functions marked `compilable`."""
    for call in COMPILABLE:
        if call.func not in _PLAIN:
            if call.func not in _MACHINE:
                _MACHINE[call.func] = kernel(shared(call.func))
            _PLAIN[_MACHINE[call.func]] = call.func
            call.__setstate__((_MACHINE[call.func], (), {}, {}))


def interpret_all() -> None:
    """Undo `compile_all`."""
    for call in COMPILABLE:
        if call.func in _PLAIN:
            call.__setstate__((_PLAIN[call.func], (), {}, {}))


_MACHINE: dict[Callable[..., Any], Any] = {}
_PLAIN: dict[Any, Callable[..., Any]] = {}


def plain(function: F) -> F:
    """Original function of a kernel or part, for occasional calls from Python."""
    original: F = function.py_func  # type: ignore[attr-defined]
    return original


class DependencyStamp:
    """Mix-in for a numba cache locator; its stamp depends on all code and constants of a kernel."""

    def get_source_stamp(self) -> str:
        return self.stamp

    def get_disambiguator(self) -> str:
        """Part of the file's name: the stamp, so that files with another stamp are never opened."""
        return self.stamp[:16]

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        locator = super().from_function(py_func, py_file)  # type: ignore[misc]
        if locator is not None:
            locator.stamp = stamp(py_func)
        return locator

    stamp: str


class NamedFolder(DependencyStamp, caching.UserProvidedCacheLocator):  # type: ignore[misc]
    pass


class SourceFolder(DependencyStamp, caching.InTreeCacheLocator):  # type: ignore[misc]
    pass


class UserFolder(DependencyStamp, caching.UserWideCacheLocator):  # type: ignore[misc]
    pass


class CacheFolders(caching.CompileResultCacheImpl):  # type: ignore[misc]
    """Folders for machine code, in order of preference: NUMBA_CACHE_DIR, `__pycache__` beside the
    source, the user's cache folder.
    """

    _locator_classes = (NamedFolder, SourceFolder, UserFolder)


class KernelCache(caching.FunctionCache):  # type: ignore[misc]
    """Machine code of a kernel on disk.

    Before reading it, numba's own cache imports all compiler support for Python and numpy: 0.3 s
    and 36 MB. Stored machine code does not need these modules; compiling imports them anyway.
    """

    _impl_class = CacheFolders

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def stamp(function: Callable[..., Any]) -> str:
    """Digest of a kernel, and of all types, compiled functions and constants that it uses."""
    hints = get_type_hints(function, include_extras=True)
    dependencies = {"types": repr([_type_name(hint) for hint in hints.values()])}
    for each in _dependencies(function):
        place = f"{each.__module__}.{each.__qualname__}"
        dependencies[place] = _source(each)
        for name in each.__code__.co_names:
            value: Any = each.__globals__.get(name)
            if isinstance(value, type) and hasattr(value, "_fields"):
                dependencies[f"{place}: {name}"] = _type_name(value)
            elif isinstance(value, int | float | str | tuple | np.dtype):
                dependencies[f"{place}: {name}"] = repr(value)
    return hashlib.sha256(repr(sorted(dependencies.items())).encode()).hexdigest()


def _dependencies(function: Callable[..., Any]) -> list[Callable[..., Any]]:
    """A function and all functions that it calls, as Python functions."""
    reached, waiting = [], [function]
    while waiting:
        candidate = waiting.pop()
        if candidate in reached:
            continue
        reached.append(candidate)
        for called in map(candidate.__globals__.get, candidate.__code__.co_names):
            plain_one: Any = getattr(called, "py_func", called)
            if inspect.isfunction(plain_one):
                waiting.append(plain_one)
    return reached


def _source(function: Callable[..., Any]) -> str:
    """Source lines of a function, from its first decorator to its last instruction.

    `inspect.getsource` would find the end with a tokenizer, and take 0.1 s at each start.
    """
    code = function.__code__
    end = max(line or 0 for _, line, _, _ in code.co_positions())
    return "".join(linecache.getlines(code.co_filename)[code.co_firstlineno - 1 : end])


def _type_name(hint: Any) -> str:
    if not hasattr(hint, "_fields"):
        return repr(hint)
    fields = get_type_hints(hint, include_extras=True)
    names = (f"{name}: {_type_name(field)}" for name, field in fields.items())
    return f"{hint.__module__}.{hint.__qualname__}({', '.join(names)})"
