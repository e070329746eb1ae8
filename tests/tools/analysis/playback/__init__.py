"""Tests of `tools/analysis/playback`."""
