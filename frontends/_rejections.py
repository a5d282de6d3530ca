# SPDX-License-Identifier: Apache-2.0
"""What a message that gives no measurement is answered with."""

from __future__ import annotations

from typing import NamedTuple

from graphloc.ledger import Outcome


class Rejection(NamedTuple):
    """A message that gives no measurement, and why."""

    outcome: Outcome
    reason: str


def malformed(reason: str) -> Rejection:
    """A message whose content cannot be used."""
    return Rejection(Outcome.MALFORMED, reason)


def rejected(reason: str) -> Rejection:
    """A well-formed message that says itself that it is not to be used, or is not believed."""
    return Rejection(Outcome.REJECTED, reason)


def ignored(reason: str) -> Rejection:
    """A message on the sensor's topic that is not for it."""
    return Rejection(Outcome.IGNORED, reason)
