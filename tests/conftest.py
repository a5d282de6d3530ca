# SPDX-License-Identifier: Apache-2.0
"""Settings of the whole test run."""

import gc

gc.set_threshold(100_000, 20, 100)  # runs that tests share are millions of objects: looking through them again took a tenth of the time
