"""The report of a run as one page, and its 3-D scene for viewers."""
