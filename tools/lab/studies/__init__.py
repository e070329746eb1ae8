"""Studies: many cases, run one after the other or side by side, each judged and counted."""
