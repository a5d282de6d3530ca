# SPDX-License-Identifier: Apache-2.0
"""Loops compiled by numba, and kept on disk where there is a place for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def compiled(**options: Any) -> Callable[[Any], Any]:
    """Return a decorator like `numba.njit(**options)` that caches on disk where a folder is writable.

    A service without a home folder, with graphloc installed read-only, has none: it compiles at each start.
    Nothing here is called from C: an entry for that takes a seventh of the compilation.
    """
    options["no_cfunc_wrapper"] = True

    def compile_(function: Any) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # "no locator available"
            return numba.njit(**options)(function)

    return compile_
