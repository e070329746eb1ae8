"""Tests of the verbs: flags, output, exit codes."""
