# SPDX-License-Identifier: Apache-2.0
"""The online mode: measurements in, in the order they arrive; a pose out, at once."""

from graphloc.online._smoother import OnlineSmoother

__all__ = ["OnlineSmoother"]
