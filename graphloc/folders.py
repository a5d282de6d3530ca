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
        OutputError: the nearest folder that is there may not be written to.
    """
    around = next(folder for folder in path.absolute().parents if folder.exists())
    if not around.is_dir():
        raise OutputError(f"{path}: {around} is a file, and a folder is wanted")
    if not os.access(around, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: cannot be written ({os.strerror(errno.EACCES)} in {around})")


@contextmanager
def fresh_folder(folder: Path, *, overwrite: bool, mark: str) -> Iterator[Path]:
    """Yield a folder to fill; move it to `folder` when all went well, and drop it when not.

    Raises:
        OutputError: `folder` exists and may not be replaced, or the disk refuses.
    """
    check_folder(folder, overwrite=overwrite, mark=mark)
    fresh = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        fresh.chmod(0o755)
        yield fresh
        if folder.exists():
            shutil.rmtree(folder)
        fresh.rename(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error})") from error
    finally:
        if fresh is not None and fresh.exists():
            shutil.rmtree(fresh, ignore_errors=True)
