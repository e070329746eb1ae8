"""Tests of `tools/playback`."""
