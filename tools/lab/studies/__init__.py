"""Studies: many cases, run in sequence or in parallel, each judged and counted."""
