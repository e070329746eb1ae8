"""Judges a run: verdict, figures, picture and report page."""
