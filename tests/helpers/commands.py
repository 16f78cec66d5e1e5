"""What a command of `nsde` says in this process."""

from __future__ import annotations

from collections.abc import Callable

Said = Callable[..., str]
"""Runs `nsde WORDS` and gives what it printed: `shown` where it ends well, `refused` where the user is at fault."""
