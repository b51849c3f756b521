"""What holds for every test: an example takes as long as it takes, because machines are busy; no time is asserted."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("untimed", parent=settings(), deadline=None)  # else as ever: in CI not random
settings.load_profile("untimed")
