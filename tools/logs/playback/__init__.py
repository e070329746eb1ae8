"""Parts of `xrl log play`: reading, selection of keys, schedule, player, keys."""
