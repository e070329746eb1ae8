"""`xrl view`: shows the robot in a browser, from a record, a fleet or lockstep (docs/view.md)."""
