"""Leading with a gamepad or the keyboard: the pad's state, and the motion that it commands."""
