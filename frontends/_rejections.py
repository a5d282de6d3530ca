# SPDX-License-Identifier: Apache-2.0
"""Results of decoding a message that gives no measurement."""

from __future__ import annotations

from typing import NamedTuple

from graphloc.ledger import Outcome


class Rejection(NamedTuple):
    """A message that gives no measurement, and why."""

    outcome: Outcome
    reason: str


def malformed(reason: str) -> Rejection:
    """Return the rejection of a message with unusable content."""
    return Rejection(Outcome.MALFORMED, reason)


def rejected(reason: str) -> Rejection:
    """Return the rejection of a well-formed message that declares itself invalid, or is not plausible."""
    return Rejection(Outcome.REJECTED, reason)


def ignored(reason: str) -> Rejection:
    """Return the rejection of a message that is not meant for the sensor."""
    return Rejection(Outcome.IGNORED, reason)
