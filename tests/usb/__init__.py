"""ODrives on an emulated USB bus."""
