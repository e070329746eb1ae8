"""Parts of `xrl log play`: arguments, guard, reading, selection, schedule, player."""
