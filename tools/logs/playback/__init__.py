"""Parts of `xrl play`: reading, selection of keys, schedule, player, keys."""
