# SPDX-License-Identifier: Apache-2.0
"""graphloc: factor-graph localisation for vessels where GNSS lies."""

import logging

__version__ = "0.1.0"
__all__ = ["__version__"]

logging.getLogger(__name__).addHandler(logging.NullHandler())
