"""Judgement of a run: verdict, soundness, stalls, figures, report."""
