"""A robot on several hosts as one thing: what runs where, and each host's files (docs/hosts.md)."""
