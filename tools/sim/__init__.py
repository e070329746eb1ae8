"""The robot in virtual time: every service in one process, in lockstep."""
