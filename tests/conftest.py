# SPDX-License-Identifier: Apache-2.0
"""Settings of the whole test run."""

import gc

gc.set_threshold(100_000, 20, 100)  # looking again and again through runs that tests share took 3 % of the time
