# SPDX-License-Identifier: Apache-2.0
"""Memory that was freed, but that the process still holds."""

from __future__ import annotations

import ctypes
import sys


def give_back_memory() -> None:
    """Return freed memory to the system, where the C library can (glibc).

    GTSAM frees trees and graphs in millions of small pieces, which the C library keeps for the next ones. The large
    arrays of numpy do not fit there, so the two add up.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
