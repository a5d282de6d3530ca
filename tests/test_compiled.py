"""Compiled loops where nothing may be cached: a service without a home, of a package that it may not write to."""

from __future__ import annotations

import linecache
from typing import Any

import numba
import pytest

from graphloc.frontends._compiled import compiled


def test_without_a_place_for_a_cache_it_compiles_all_the_same() -> None:
    space: dict[str, Any] = {}
    exec("def twice(x):\n    return 2 * x\n", space)  # noqa: S102 - a function without a file has no place for its cache
    assert not linecache.getlines("<string>")
    with pytest.raises(RuntimeError, match="no locator available"):
        numba.njit(cache=True)(space["twice"])
    assert compiled(nogil=True)(space["twice"])(21) == 42
