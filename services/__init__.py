"""The processes of the runtime. A service imports `shared` and itself, no other service."""
