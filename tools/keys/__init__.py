"""A robot's authority, its certificates, and each host's bundle of them (docs/security.md)."""
