"""What a run was worth: verdict, soundness, stalls, figures, report."""
