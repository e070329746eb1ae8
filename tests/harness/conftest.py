from __future__ import annotations

from hypothesis import settings

# A busy machine is no failed claim: no time limit for one example.
settings.register_profile("no_deadline", deadline=None)
settings.load_profile("no_deadline")
