"""Authority, certificates and key bundles of a robot (docs/security.md)."""
