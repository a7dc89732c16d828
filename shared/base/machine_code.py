"""Kernels without machine code, to be compiled before a flight."""

from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numba
from numba.core import caching

from skytether.shared.base.kernel import (
    KERNELS,
    CacheFolders,
    compile_kernel,
    signature_of,
    stamp,
    store_on_disk,
)


class Missing(NamedTuple):
    """Kernel without machine code in memory or on disk."""

    name: str
    is_stored: bool
    compile: Callable[[], None]
    """Function that compiles the kernel, or loads machine code that another process has compiled
    since."""
    is_compiled: Callable[[], bool]
    """Function that returns whether another process has compiled the kernel since."""


def missing(without: Collection[str] = ()) -> list[Missing]:
    """Kernels without machine code in memory or on disk, the slowest to compile first; `without`
    names modules to leave out.
    """
    uncompiled = [
        each
        for each in KERNELS
        if each.__module__ not in without and not (each.overloads or _is_stored(each))
    ]
    return [
        Missing(
            _name(each),
            not isinstance(each._cache, caching.NullCache),
            partial(compile_kernel, each),
            partial(_is_stored, each),
        )
        for each in sorted(uncompiled, key=_extent, reverse=True)
    ]


def compile_named(name: str) -> None:
    import_module(name.partition(":")[0])
    (dispatcher,) = (each for each in KERNELS if _name(each) == name)
    compile_kernel(dispatcher)


def _name(dispatcher: Any) -> str:
    return f"{dispatcher.__module__}:{dispatcher.py_func.__qualname__}"


def _extent(dispatcher: Any) -> int:
    """Number of arguments, including the parts of tuples; the compile time grows with it."""

    def parts(kind: Any) -> int:
        return sum(map(parts, kind)) if isinstance(kind, numba.types.BaseTuple) else 1

    return sum(map(parts, signature_of(dispatcher)))


def _is_stored(dispatcher: Any) -> bool:
    store_on_disk(dispatcher)
    cache = dispatcher._cache
    if isinstance(cache, caching.NullCache):
        return False
    key = cache._index_key(signature_of(dispatcher), dispatcher.targetctx.codegen())
    return key in cache._cache_file._load_index()  # loading the code itself takes ten times as long


def folder() -> Path | None:
    """Folder for the machine code of kernels; None if machine code is not stored."""
    with suppress(RuntimeError):  # no folder is writable
        place = CacheFolders(stamp)
        place.locator.ensure_cache_path()
        return Path(place.locator.get_cache_path())
    return None
