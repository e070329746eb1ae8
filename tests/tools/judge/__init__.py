"""Tests of the reports, the verdict and the export of logs."""
