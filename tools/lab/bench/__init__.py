"""What each part of the fleet costs: warm and cold, two revisions in turn."""
