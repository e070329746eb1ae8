"""Tests of `tools/logs/playback`."""
