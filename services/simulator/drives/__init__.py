"""The drives' firmware and the motors, twelve axes at a time."""
