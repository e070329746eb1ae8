"""`xrl view`: the robot in a browser, of a record, a live fleet or in lockstep (docs/view.md)."""
