# SPDX-License-Identifier: Apache-2.0
"""Folders that are written whole or not at all, and replaced only where they are ours."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from graphloc.errors import OutputError


def check_folder(folder: Path, *, overwrite: bool, mark: str) -> None:
    """Refuse a folder that `fresh_folder` would refuse, before the work is done.

    A folder is replaced only if it holds the file `mark`, so that nobody's own work is.

    Raises:
        OutputError: `folder` exists and may not be replaced, there is a file in its place, or it cannot be made there.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file, and a folder is wanted")
    if folder.exists() and not (overwrite and (folder / mark).exists()) and any(folder.iterdir()):
        what = (
            f"holds no {mark}, so graphloc did not make it: it is not replaced"
            if overwrite
            else "exists already; give --overwrite"
        )
        raise OutputError(f"{folder}: {what}")
    check_writable(folder)


def check_writable(path: Path) -> None:
    """Refuse a path at which nothing can be written. It need not exist, nor the folders that it lies in.

    Raises:
        OutputError: it is a folder that may not be written to, or else the nearest folder around it that is there.
    """
    whole = path.absolute()
    around = whole if whole.is_dir() else next(folder for folder in whole.parents if folder.exists())
    if not around.is_dir():
        raise OutputError(f"{path}: {around} is a file, and a folder is wanted")
    if not os.access(around, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: cannot be written ({os.strerror(errno.EACCES)} in {around})")


@contextmanager
def fresh_folder(folder: Path, *, overwrite: bool, mark: str) -> Iterator[Path]:
    """Yield a folder to fill; put it in the place of `folder` when all went well, and drop it when not.

    Raises:
        OutputError: `folder` exists and may not be replaced, or the disk refuses; what was filled already is kept then.
    """
    check_folder(folder, overwrite=overwrite, mark=mark)
    place, fresh, filled = folder.resolve(), None, False  # where it is a link, what it leads to is replaced
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place if _stays(place) else place.parent))
        fresh.chmod(0o755)
        yield fresh
        filled = True
        _put_in_place(fresh, place)
    except OSError as error:
        kept = f"; what was made lies in {fresh}" if filled and fresh is not None and fresh.exists() else ""
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error}){kept}") from error
    finally:
        if fresh is not None and not filled:
            shutil.rmtree(fresh, ignore_errors=True)


def _stays(place: Path) -> bool:
    """Return whether a folder is there and cannot be replaced as a whole: mounted, where the user stands, or in a folder of another's."""
    return place.is_dir() and (place.is_mount() or place == Path.cwd() or not os.access(place.parent, os.W_OK))


def _put_in_place(fresh: Path, place: Path) -> None:
    if fresh.parent != place:
        if place.exists():
            shutil.rmtree(place)
        fresh.rename(place)
        return
    for old in [p for p in place.iterdir() if p != fresh]:
        if old.is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        else:
            old.unlink()
    for new in list(fresh.iterdir()):
        new.rename(place / new.name)
    fresh.rmdir()
