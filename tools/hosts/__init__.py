"""A robot on several hosts: what runs where, and each host's files (docs/hosts.md)."""
