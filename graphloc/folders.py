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

_UNFINISHED = ".graphloc-"  # how the name of a folder begins that is being filled, or was when its process was killed


def check_folder(folder: Path, *, overwrite: bool, mark: str) -> None:
    """Refuse a folder that `fresh_folder` would refuse, before the work is done.

    A folder is replaced only if it holds the file `mark`, so that nobody's own work is.

    Raises:
        OutputError: `folder` exists and may not be replaced, there is a file in its place, or it cannot be made there.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file, and a folder is wanted")
    begun = folder.exists() and any(not p.name.startswith(_UNFINISHED) for p in folder.iterdir())
    if begun and not (overwrite and (folder / mark).exists()):
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
    """Yield a folder to fill; move it to `folder` when all went well, and drop it when not.

    A folder that is there is kept, its content replaced: it may be a link, mounted, or where the user stands.

    Raises:
        OutputError: `folder` exists and may not be replaced, or the disk refuses; what was filled already is kept then.
    """
    check_folder(folder, overwrite=overwrite, mark=mark)
    fresh, filled = None, False
    try:
        there = folder.exists()
        folder.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=_UNFINISHED, dir=folder if there else folder.parent))
        fresh.chmod(0o755)
        yield fresh
        filled = True
        if there:
            _replace_content(folder, fresh)
        else:
            fresh.rename(folder)
    except OSError as error:
        kept = f"; what was made lies in {fresh}" if filled else ""
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error}){kept}") from error
    finally:
        if fresh is not None and not filled:
            shutil.rmtree(fresh, ignore_errors=True)


def _replace_content(folder: Path, fresh: Path) -> None:
    """Replace what is in a folder by what is in one inside of it."""
    for old in list(folder.iterdir()):
        if old.is_symlink() or not old.is_dir():
            old.unlink()
        elif old.name != fresh.name:
            shutil.rmtree(old)
    for new in list(fresh.iterdir()):
        new.rename(folder / new.name)
    fresh.rmdir()
