"""Named channels, each with the source of its numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Profile:
    """A channel in the short form, what it stands for, and where its numbers come from."""

    channel: str
    summary: str
    source: str


PROFILES: dict[str, Profile] = {}
