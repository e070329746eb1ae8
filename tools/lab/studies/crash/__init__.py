"""The crash matrix: the service that dies, the expected outcome, and the judgement."""
