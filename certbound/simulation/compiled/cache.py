"""Generated kernels: compiled once, kept on disk where nobody else can write.

Compiled code is loaded from the cache, so that whoever can write there could run code as the user. The cache
is therefore used only if its directory belongs to the user, is closed to everybody else, and no directory
above it can be exchanged by others; otherwise kernels are compiled in memory. The name of a file is a hash of
its content and of everything that its compiled form depends on; the source that runs is the one just
generated, never one read from disk.
"""

from __future__ import annotations

import ast
import hashlib
import json
import logging
import os
import stat
import sys
import tempfile
import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from certbound._version import __version__
from certbound.lazy import uncollected
from certbound.simulation.compiled.entry import FOLLOW, KERNEL, enter, entered
from certbound.simulation.compiled.particles import replicate
from certbound.simulation.compiled.translation import translatable, translated
from certbound.watch import undisturbed

logger = logging.getLogger(__name__)

_KEPT = 256
_LOCK = threading.RLock()
_LOADED: dict[str, Callable[..., Any]] = {}


def cache_directory() -> Path | None:
    """The private folder of compiled kernels, made if need be; None where no safe one can be had.

    ``CERTBOUND_CACHE`` chooses another place; the value ``off`` switches the cache off.
    """
    chosen = os.environ.get("CERTBOUND_CACHE", "")
    if chosen == "off":
        return None
    if chosen:
        base = Path(chosen)
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "certbound"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "certbound"
    folder = base.absolute() / "kernels"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if is_private(folder):
            return folder
    except OSError as error:
        logger.warning("kernels are not cached: %s", error)
        return None
    logger.warning("kernels are not cached: others could write to %s (chmod 700 it)", folder)
    return None


def is_private(folder: Path) -> bool:
    """Whether only this user can put files into ``folder`` or exchange it for another.

    The folder is the user's own and has mode 0700 or less; every folder above it belongs to the user or to
    root, and is either closed to other writers or sticky (as /tmp is).
    """
    if sys.platform == "win32":  # access lists protect the profile folder there
        return True
    user = os.getuid()
    own = folder.lstat()
    if not stat.S_ISDIR(own.st_mode) or own.st_uid != user or own.st_mode & 0o077:
        return False
    for parent in folder.resolve().parents:
        status = parent.stat()
        if status.st_uid not in (user, 0) or (status.st_mode & 0o022 and not status.st_mode & stat.S_ISVTX):
            return False
    return True


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees all of it or none, also after a crash."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


@lru_cache(maxsize=1)
def _fingerprint() -> str:
    """What a compiled kernel depends on besides its own source."""
    import numba

    here = Path(__file__)
    names = ("cache.py", "elementary.py", "entry.py", "particles.py", "streams.py", "supremum.py", "translation.py")
    helpers = b"".join(here.with_name(name).read_bytes() for name in names)
    return f"{__version__} {numba.__version__} {sys.version} {hashlib.sha256(helpers).hexdigest()}"


def load_kernel(source: str) -> Callable[..., Any]:
    """The function ``run`` of a generated module, compiled or loaded from the cache.

    ``@CACHE@`` stands for the cache switch in what `certbound.simulation.kernel_source` writes.
    """
    digest = hashlib.sha256(f"{_fingerprint()}\n{source}".encode()).hexdigest()[:32]
    with _LOCK, undisturbed(), uncollected():  # numba's registries do not survive an exception while they are filled
        if digest not in _LOADED:
            folder = cache_directory()
            try:
                _LOADED[digest] = _run(digest, source, folder)
            except (FileNotFoundError, RuntimeError) as error:  # another process drops the oldest kernels too
                if isinstance(error, RuntimeError) and (folder is None or _source(folder, digest).exists()):
                    raise
                logger.info("kernel %s is not cached: %s", digest, error)
                _LOADED[digest] = _run(digest, source, None)
        return _LOADED[digest]


def _run(digest: str, source: str, folder: Path | None) -> Callable[..., Any]:
    """The function ``run`` of a module, by the compiled form in ``folder`` if there is one."""
    text = source.replace("@CACHE@", str(folder is not None))
    module = ModuleType(f"certbound_kernel_{digest}")
    sys.modules[module.__name__] = module  # numba looks it up when it loads the compiled form
    path = None if folder is None else _source(folder, digest)
    if path is not None:
        _store(path, text.encode())
        _drop_damaged(path)
    # The text was written by this package a moment ago, from a validated tape.
    tree = ast.parse(text)
    if translatable(tree):
        tree = translated(tree, module.__dict__)
    exec(compile(tree, str(path or f"<kernel {digest}>"), "exec"), module.__dict__)  # noqa: S102
    if path is not None:
        _seal(path)
    return entered(module.run, ((KERNEL, enter), (FOLLOW, replicate)))


def _source(folder: Path, digest: str) -> Path:
    return folder / f"kernel_{digest}.py"


def _store(path: Path, content: bytes) -> None:
    """Keep the source beside its compiled form (numba compares time and size); drop the oldest ones."""
    if not path.exists() or path.read_bytes() != content:
        write_atomically(path, content)
        for old in sorted(path.parent.glob("kernel_*.py"), key=_written)[:-_KEPT]:
            for file in [old, _manifest(old), *_compiled(old)]:
                file.unlink(missing_ok=True)


def _written(file: Path) -> float:
    """When a file was written; long ago where another process has just dropped it."""
    try:
        return file.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _manifest(path: Path) -> Path:
    return path.with_suffix(".json")


def _compiled(path: Path) -> list[Path]:
    return sorted((path.parent / "__pycache__").glob(f"{path.stem}.*"))


def _hashes(path: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in _compiled(path)}


def _drop_damaged(path: Path) -> None:
    """Delete compiled files that are not those which were sealed (half-written, say): they are made anew."""
    try:
        sealed = json.loads(_manifest(path).read_bytes())
    except (OSError, ValueError):
        sealed = None
    if sealed != _hashes(path):
        for file in _compiled(path):
            file.unlink(missing_ok=True)


def _seal(path: Path) -> None:
    content = json.dumps(_hashes(path), sort_keys=True).encode()
    if not _manifest(path).exists() or _manifest(path).read_bytes() != content:
        write_atomically(_manifest(path), content)
