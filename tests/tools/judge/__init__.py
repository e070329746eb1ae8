"""Tests of the reports, the re-execution and the playback of logs."""
