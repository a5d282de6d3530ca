# SPDX-License-Identifier: Apache-2.0
"""Memory that is free and still the process's."""

from __future__ import annotations

import ctypes
import sys


def give_back_memory() -> None:
    """Return free memory to the system, where the C library can (glibc).

    GTSAM frees trees and graphs in millions of small pieces, which the C library keeps for the next ones; numpy's large
    arrays find no place there, so that both add up.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
