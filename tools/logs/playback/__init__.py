"""Parts of `xrl log play`: guard, reading, selection, schedule, player."""
