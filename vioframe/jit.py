"""Compiling hot loops: :func:`kernel` is numba's ``njit`` with a cache on disk that may be trusted.

numba's own cache looks at the file of the function alone. Where a kernel calls one of another file, and only that one
changed, it runs the old code or fails to link. Here the cache lies in a folder named after the text of *all* kernels,
so that any change begins a new one.

What is loaded from it brings the modules of whatever it calls that numba has written in Python: of ``np.argmin`` or
``a.sum()`` one that imports scipy's linear algebra. Kernels that the first frame waits for do without.
"""

from __future__ import annotations

import gc
import hashlib
import os
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from time import perf_counter, thread_time
from types import ModuleType
from typing import IO, Any, TypeVar, cast, overload

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.runtime.nrt import rtsys

from vioframe.locks import locked

FunctionT = TypeVar("FunctionT", bound=Callable[..., object])

_PACKAGE = Path(__file__).parent

_told: list[Callable[[str], None]] = []


@overload
def kernel(function: FunctionT) -> FunctionT: ...
@overload
def kernel(*, reorder_sums: bool = False, inlined: bool = False) -> Callable[[FunctionT], FunctionT]: ...
def kernel(
    function: FunctionT | None = None, *, reorder_sums: bool = False, inlined: bool = False
) -> FunctionT | Callable[[FunctionT], FunctionT]:
    """Compile ``function`` in nopython mode at its first call, or load it from the cache.

    It divides as numpy does: by zero is no error. Loops with divisions can be vectorised then; those that sum, where
    it may ``reorder_sums``, which lets their last digits depend on the processor. What it calls must be ``inlined``
    then: others are compiled alone and again with their caller, and either may be run. Threads run beside it.
    """
    if function is None:
        return partial(_compiled, reorder_sums=reorder_sums, inlined=inlined)
    return _compiled(function, reorder_sums, inlined)


def _compiled(function: FunctionT, reorder_sums: bool, inlined: bool) -> FunctionT:
    source = Path(function.__code__.co_filename)
    in_package = (source.parent / "__init__.py").exists()
    settings: Any = numba.config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(_folder(before) / _fingerprint(source.parent if in_package else source))
    njit: Any = numba.njit
    compile_lazily = njit(
        error_model="numpy",
        nogil=True,
        no_cfunc_wrapper=True,  # nothing calls it from C
        fastmath={"reassoc", "nsz"} if reorder_sums else False,
        inline="always" if inlined else "never",
    )
    try:
        compiled = compile_lazily(function)
        compiled._cache = _Cache(function)  # where ``cache=True`` would put numba's own
        return cast(FunctionT, compiled)
    finally:
        settings.CACHE_DIR = before


class _Cache(FunctionCache):
    """numba's own, with two differences.

    What is loaded is not preceded by all that compiling needs: 0.1 s before anything else. And of the processes that
    need what is nowhere yet, one compiles it, while the others wait and load it.
    """

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._lock: IO[str] | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # arrays are allocated by it
        found = self._found(sig, target_context)
        if found is None and self._lock is None:
            # What it calls is compiled within, never the other way round: nobody waits for one who waits for him.
            with suppress(OSError):  # a folder that cannot be written to takes no kernels either
                self._lock = locked(Path(f"{self._cache_file._index_path}.lock"), wait=True)
            _locking.caches.add(self)
            found = self._found(sig, target_context)
            if found is not None:
                self.unlock()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        self.unlock()

    def unlock(self) -> None:
        """Others may look whether it is there, or compile it."""
        _locking.caches.discard(self)
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def is_filled(self) -> bool:
        """Whether something lies in it."""
        return Path(self._cache_file._index_path).exists()

    def _found(self, sig: Any, target_context: Any) -> Any:
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


class _Locking(threading.local):
    def __init__(self) -> None:
        self.caches = set[_Cache]()


_locking = _Locking()


@contextmanager
def heard(tell: Callable[[str], None]) -> Iterator[None]:
    """Within it ``tell`` is called with the name of each kernel that has to be compiled: none, once all are cached."""
    _told.append(tell)
    try:
        yield
    finally:
        _told.remove(tell)


def tell_of(kernel: str) -> None:
    """Have it ``heard`` here that ``kernel`` is compiled, be it by another process."""
    for tell in tuple(_told):
        tell(kernel)


_CLOCKS = (perf_counter, thread_time)


class _Waiting(event.Listener):
    """Sums up how long each thread was held up, by each of the clocks, the outermost of what is nested alone.

    It has no garbage collected meanwhile: a compiler makes objects by the million that all stay in use, and looking
    through them again and again is a tenth of its time.
    """

    def __init__(self) -> None:
        self._thread = threading.local()

    def on_start(self, begun: Any) -> None:
        thread = self._thread
        thread.depth = getattr(thread, "depth", 0) + 1
        if thread.depth == 1:
            thread.begin_s, thread.collected = [clock() for clock in _CLOCKS], gc.isenabled()
            gc.disable()

    def on_end(self, begun: Any) -> None:
        thread = self._thread
        thread.depth -= 1
        if thread.depth == 0:
            ends_s = zip(_CLOCKS, thread.begin_s, strict=True)
            thread.seconds = {clock: self.seconds(clock) + clock() - begin_s for clock, begin_s in ends_s}
            if thread.collected:
                gc.enable()
            for left in tuple(_locking.caches):  # what could not be compiled
                left.unlock()

    def seconds(self, clock: Callable[[], float]) -> float:
        waited: dict[Callable[[], float], float] = getattr(self._thread, "seconds", {})
        return waited.get(clock, 0.0)


_waiting = _Waiting()
event.register("numba:compiler_lock", _waiting)  # type: ignore[no-untyped-call]


def have_been_compiled(module: ModuleType) -> bool:
    """Whether all kernels of ``module`` lie in the cache: then to load them costs little."""
    own = [each for each in vars(module).values() if getattr(each, "__module__", None) == module.__name__]
    kernels = [each for each in own if isinstance(getattr(each, "_cache", None), _Cache)]
    return all(each._cache.is_filled() for each in kernels if each.targetoptions["inline"] == "never")


def waited_s(clock: Callable[[], float] = perf_counter) -> float:
    """How long this thread has waited by now for kernels to be compiled or loaded from the cache, s.

    By the ``clock``, or by ``thread_time``: what the thread itself has computed for it.
    """
    return _waiting.seconds(clock)


class _Compiling(event.Listener):
    def on_start(self, begun: Any) -> None:
        function = begun.data["dispatcher"].py_func
        if not function.__module__.startswith("numba."):  # what a kernel calls of numba's own
            tell_of(function.__name__)

    def on_end(self, begun: Any) -> None:
        """What is compiled is of use at once."""


event.register("numba:compile", _Compiling())  # type: ignore[no-untyped-call]


def _folder(chosen: str) -> Path:
    """Where caches go: what the user told numba, or the user's cache folder, or a temporary one that can be written."""
    if chosen:
        return Path(chosen)
    # In a container that does not know its user there is no home to be found: a RuntimeError.
    with suppress(OSError, RuntimeError):
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vioframe" / "kernels"
        home.mkdir(parents=True, exist_ok=True)
        if os.access(home, os.W_OK):
            return home
    return _temporary_folder()


@cache
def _temporary_folder() -> Path:
    """One that stays and only its owner can write to; a new one where somebody else was there first.

    What lies in a cache is run: from a folder that others can fill it would be their code.
    """
    folder = Path(tempfile.gettempdir()) / f"vioframe-kernels-{os.getuid()}"
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
            return folder
    return Path(tempfile.mkdtemp(prefix="vioframe-kernels-"))


@cache
def _fingerprint(own: Path) -> str:
    """A hash of every source that has kernels: vioframe's, and those of the plug-in at ``own``."""
    texts = _texts(_PACKAGE) | _texts(own)
    return hashlib.sha256(b"\0".join(sorted(texts))).hexdigest()[:16]


@cache
def _texts(own: Path) -> frozenset[bytes]:
    paths = [own] if own.is_file() else own.rglob("*.py")
    return frozenset(text for path in paths if b"vioframe.jit" in (text := path.read_bytes()))
