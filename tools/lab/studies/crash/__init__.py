"""The crash matrix: which service dies, the expected outcome, and the judgement."""
