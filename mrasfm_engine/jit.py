"""numba's `njit` for the engine's kernels: what it keeps of them on the disk is renewed with all of their sources.

numba compiles a kernel anew when the file that it stands in has changed. What the kernel calls in other files, and the
constants that it takes from them, are compiled into it: after an update of those alone it would go on as before.

`uncounted` is `njit` for what kernels do with every observation.
"""

from __future__ import annotations

import hashlib
import re
import sys
import time
from collections.abc import Callable
from enum import EnumMeta
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any
from uuid import uuid4

import numba
from numba import njit
from numba.core import caching

__all__ = ["njit", "source_files", "uncounted"]

PACKAGE = Path(__file__).resolve().parent
BEGUN_S = time.time()
_IMPORT = re.compile(r"^from ((?:mrasfm_engine|schemas)[\w.]*) import (?:\(([^)]*)\)|([^\n]*))", re.MULTILINE)


def uncounted(*, forceinline: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """`njit` without reference counts, for what kernels do with every observation.

    numba counts a reference whenever code takes a row of an array, or an array out of a tuple: an atomic addition, and
    another one when it lets go. A point's projection is 20 ns of arithmetic; counted, it takes 160. Without counts a
    function only borrows: numba refuses to compile one that makes an array, and it must not return one that it was
    given (a test looks). Kernels ask for their memory once, and then call such a function with it.

    `_nrt` is numba's own switch for this; as it is not documented for users, it is one more reason for the pin.
    """
    return njit(  # type: ignore[no-any-return]
        cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp"}, _nrt=False,
        forceinline=forceinline,
    )  # fmt: skip


def source_files(module: str) -> list[Path]:
    """Files that the kernels of an imported module are compiled of: its own, and those of what it takes from others.

    These are the modules of the package that it imports a kernel, a constant or a named tuple from, what these import,
    and so on. Other functions and classes of Python are not compiled into kernels.
    """
    found: dict[str, Path] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found and (file := getattr(sys.modules.get(name), "__file__", None)) is not None:
            found[name] = Path(file)
            waiting += _origins(name)
    return sorted(found.values())


@cache
def _origins(module: str) -> frozenset[str]:
    """Modules that a module imports from what may be compiled into its kernels."""
    here = sys.modules[module]
    result = set()
    text = re.sub("#.*", "", _text(Path(str(here.__file__))))
    for origin, in_lines, in_one_line in _IMPORT.findall(text):
        for imported in (in_lines or in_one_line).split(","):
            names = imported.split()
            value = getattr(here, names[-1], None) if names else None
            if isinstance(value, ModuleType):
                result.add(value.__name__)
            elif value is not None and not _is_of_python(value):
                result.add(origin)
    return frozenset(result)


def _is_of_python(value: object) -> bool:
    """Functions, classes but for those of constants and named tuples, and names of types."""
    is_class = isinstance(value, type) and not (isinstance(value, EnumMeta) or hasattr(value, "_fields"))
    return is_class or isinstance(value, FunctionType) or hasattr(value, "__origin__")


@cache
def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@cache
def _stamp(module: str) -> str:
    """Digest of the content of all sources of a module's kernels.

    Where one has changed since this process began, what it imported may not be what is there by now: that has a stamp
    of its own.
    """
    digest = hashlib.sha256()
    for path in [Path(__file__), *source_files(module)]:  # here are the options with which all are compiled
        if path.stat().st_ctime > BEGUN_S:
            return uuid4().hex
        digest.update(f"{path.name} {len(_text(path))}\n{_text(path)}".encode())
    return digest.hexdigest()


@cache
def _is_of_package(file: str) -> bool:
    path = Path(file).resolve()
    return path.is_relative_to(PACKAGE) and path.is_file()


class _OfAllSources:
    """Part of a numba cache locator, for functions of this package alone."""

    _module: str

    def get_source_stamp(self) -> str:
        """The digest with which compiled code is kept; with another one, numba compiles anew."""
        return _stamp(self._module)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """The locator of a function in a file; None where it is another's, or has no place on the disk."""
        if not (_is_of_package(py_file) and py_func.__module__ in sys.modules):
            return None
        found = super().from_function(py_func, py_file)  # type: ignore[misc]
        if found is not None:
            found._module = py_func.__module__
        return found


class _IndexOfSources(caching.IndexDataCacheFile):  # type: ignore[misc]
    """Index of a kernel's compiled forms, which is not read for other sources.

    Signatures in it name tuples of the package: one that an update has renamed cannot be read any more. numba does not
    read on where an index begins with another version.
    """

    def __init__(self, cache_path: str, filename_base: str, source_stamp: object) -> None:
        super().__init__(cache_path, filename_base, source_stamp)
        if isinstance(source_stamp, str):  # one of `_OfAllSources`
            self._version = f"{numba.__version__} {source_stamp}"


class _InGivenFolder(_OfAllSources, caching.UserProvidedCacheLocator):  # type: ignore[misc]
    """In NUMBA_CACHE_DIR."""


class _BesideSources(_OfAllSources, caching.InTreeCacheLocator):  # type: ignore[misc]
    """In __pycache__."""


class _InUsersFolder(_OfAllSources, caching.UserWideCacheLocator):  # type: ignore[misc]
    """In the user's cache, where the package may not be written."""


# numba asks its locators in this order. To add some is documented by a variable of the environment alone, which would
# be there for all programs that this one starts.
caching.CacheImpl._locator_classes[:0] = [_InGivenFolder, _BesideSources, _InUsersFolder]
caching.IndexDataCacheFile = _IndexOfSources
