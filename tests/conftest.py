# SPDX-License-Identifier: Apache-2.0
"""Settings of the whole test run."""

import gc
import os

import pytest

# As many threads of linear algebra as cores, in each of as many workers, wait for each other: 7 to 25 % of the processor's time.
# Before numpy is imported; workers and programs that tests start inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
gc.set_threshold(100_000, 20, 100)  # looking again and again through runs that tests share took 3 % of the time


@pytest.fixture
def few_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """An online start that waits for half a minute is tried at its end, not thirteen times: each solves all that there is."""
    from graphloc.online import _waiting

    monkeypatch.setattr(_waiting, "_TRY_EVERY_S", 30.2)
    monkeypatch.setattr(_waiting, "_TRY_AGAIN", 0.0)
