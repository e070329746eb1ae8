"""Report page and animated picture of a run."""
