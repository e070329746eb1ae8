"""Emulated firmware and motors of the drives, twelve axes at a time."""
