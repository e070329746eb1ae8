"""Cost of each part of the fleet: warm and cold, also of two revisions in turn."""
