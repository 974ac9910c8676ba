# SPDX-License-Identifier: Apache-2.0
"""The table of all reasons by which a stream counts drops and notes; documentation and runtime advice come from it."""

from __future__ import annotations

from paul_ros.stream.drop_reasons import DROP_REASONS
from paul_ros.stream.note_reasons import NOTE_REASONS
from paul_ros.stream.reason import PERSON, Reason

REASONS: dict[str, Reason] = {reason.slug: reason for reason in (*DROP_REASONS, *NOTE_REASONS)}
"""Slug -> Reason, in the order of the documentation: messages, other inputs, persons, notes."""


def reason_of(slug: str, kind: str) -> Reason:
    """Return the row of a reason; adapters of other packages may use reasons that have none."""
    return REASONS.get(slug) or Reason(slug, PERSON if slug.startswith("person_") else kind, "", "")
