"""Object code on disk, beside JAX's compilation cache: in a folder of the user's own, each file with a checksum."""

import contextlib
import hashlib
import os
import stat
import threading
from pathlib import Path

from .._compat import compilation_cache_folder


# Of all files together; the ones that were not used for longest go first. A solve takes 20 to 300 kB.
BOUND = 512 * 2**20
_MAGIC = b"dae_jax object code\n"


def load(key: str) -> bytes | None:
    """The object code that is kept by this key, whole and written by this user."""
    folder = _folder()
    if folder is None:
        return None
    path = folder / f"{key}.o"
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
        with open(file, "rb") as opened:
            if not _is_own(os.fstat(file)):
                return None
            found = opened.read()
        with contextlib.suppress(OSError):
            os.utime(path)
    except OSError:
        return None
    head, code = found[: len(_MAGIC) + 32], found[len(_MAGIC) + 32 :]
    return code if head == _MAGIC + hashlib.sha256(code).digest() else None


def keep(key: str, code: bytes) -> None:
    """Keeps object code, where JAX keeps its own."""
    folder = _folder()
    if folder is None:
        return
    unfinished = folder / f"{key}.{os.getpid()}.{threading.get_ident()}"
    with contextlib.suppress(OSError):
        file = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        with open(file, "wb") as opened:
            opened.write(_MAGIC + hashlib.sha256(code).digest() + code)
        unfinished.replace(folder / f"{key}.o")
        _make_room(folder)


def _folder() -> Path | None:
    """The folder, made if it is not there; `None` where there is no cache, or others can write to the folder."""
    parent = compilation_cache_folder()
    if parent is None:
        return None
    folder = Path(parent) / "dae_jax"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder if _is_own(os.lstat(folder)) else None
    except OSError:
        return None


def _is_own(found: os.stat_result) -> bool:
    """Whether nobody else can write to a file or folder; a link is not one's own."""
    writable = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return not stat.S_ISLNK(found.st_mode) and found.st_uid == os.geteuid() and not writable


def _make_room(folder: Path) -> None:
    with os.scandir(folder) as entries:
        files = [(found.stat(), found.path) for found in entries]
    total = sum(found.st_size for found, _ in files)
    for found, path in sorted(files, key=lambda item: item[0].st_mtime):
        if total <= BOUND:
            return
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
        total -= found.st_size
