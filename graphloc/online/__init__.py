# SPDX-License-Identifier: Apache-2.0
"""The online mode: takes measurements in the order of their arrival, and returns a pose at once."""

from graphloc.online._smoother import OnlineSmoother

__all__ = ["OnlineSmoother"]
