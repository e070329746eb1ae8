"""Leading by a gamepad or by keys: the pad's state, and where its deflections lead."""
