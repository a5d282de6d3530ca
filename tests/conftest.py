# SPDX-License-Identifier: Apache-2.0
"""Settings of the whole test run."""

import gc
import os

# As many threads of linear algebra as cores, in each of as many workers, wait for each other: 7 to 25 % of the processor's time.
# Before numpy is imported; workers and programs that tests start inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
gc.set_threshold(100_000, 20, 100)  # looking again and again through runs that tests share took 3 % of the time
