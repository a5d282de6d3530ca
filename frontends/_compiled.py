# SPDX-License-Identifier: Apache-2.0
"""Loops compiled by numba, and kept on disk where there is a place for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def compiled(**options: Any) -> Callable[[Any], Any]:
    """Return a decorator as `numba.njit(**options)`, which caches where it may write.

    A service without a home, of a package that it may not write to, has no such place: it compiles anew at each start.
    """

    def compile_(function: Any) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # "no locator available"
            return numba.njit(**options)(function)

    return compile_
