"""A robot on several hosts: each host's services and files (docs/hosts.md)."""
